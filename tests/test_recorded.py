"""What is recorded answers as what is worked through does: on a GPU where there is one, else it is worked through."""

from __future__ import annotations

import gc

import pytest
import torch

from caphy.recorded import WARM, Recorded

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")),
]


@pytest.mark.parametrize("device", DEVICES)
def test_each_call_answers_its_own_numbers(device: str) -> None:
    """Of two shapes in turns; what was answered before stays as it was when it is called again."""
    asked = []

    def work(a: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(len(a))
        return a @ b, (a * b.T).sum(0)

    recorded, told = Recorded(work), []
    for call in range(2 * WARM + 6):
        size = 3 + call % 2
        a, b = (torch.rand(size, size, device=device, requires_grad=True) for _ in range(2))
        told.append((a, b, recorded(a, b.mT)))
    for a, b, (product, total) in told:
        torch.testing.assert_close(product, a.detach() @ b.detach().mT)
        torch.testing.assert_close(total, (a * b).detach().sum(0))
        assert not product.requires_grad
    # Twice more, to see whether it waits and to be recorded, and then no more
    assert len(asked) == (len(told) if device == "cpu" else 2 * (WARM + 3))


@pytest.mark.parametrize("device", DEVICES)
def test_what_waits_for_its_own_numbers_is_worked_through(device: str) -> None:
    recorded = Recorded(lambda x: (x[x > float(x.mean())],))
    other = Recorded(lambda x: (2 * x,))
    for _ in range(WARM + 4):
        x = torch.rand(20, device=device)
        torch.testing.assert_close(recorded(x)[0], x[x > x.mean()])
        torch.testing.assert_close(other(x)[0], x + x)


@pytest.mark.parametrize("device", DEVICES)
def test_what_was_recorded_before_and_is_garbage_leaves_its_room(device: str) -> None:
    """As a training that is done: it refers to itself, and is collected only when another is recorded."""
    gc.disable()
    try:
        for _ in range(3):
            recorded = Recorded(lambda x: (x @ x,))
            recorded.itself = recorded  # pyright: ignore[reportAttributeAccessIssue]
            for _ in range(WARM + 3):
                x = torch.rand(30, 30, device=device)
                torch.testing.assert_close(recorded(x)[0], x @ x)
    finally:
        gc.enable()
