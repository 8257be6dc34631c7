"""The perceptual errors: FLIP's known answers, and VGG-16 against torch's own layers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from caphy.errors import CaphyError
from caphy.evaluate.perceptual import BLOCKS, DEVIATION, MEAN, Flip, Vgg16


def _picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def test_flip_knows_equal_and_opposite_pictures():
    flip = Flip()
    assert flip.error_map(_picture(), _picture()).max() == 0
    black, white = np.zeros((40, 40, 3), np.uint8), np.full((40, 40, 3), 255, np.uint8)
    # Andersson et al. 2020 scale the colour difference so that black and white nearly reach one
    assert flip.error_map(black, white)[20, 20] == pytest.approx(0.97, abs=0.03)
    grey = np.full((40, 40, 3), 130, np.uint8)
    assert 0 < flip.error_map(grey, grey + 10)[20, 20] < 0.3


def test_flip_tells_where_pictures_differ():
    one, other = np.full((60, 60, 3), 120, np.uint8), np.full((60, 60, 3), 120, np.uint8)
    other[20:30, 35:45] = (200, 60, 60)
    error = Flip().error_map(one, other)
    assert error.shape == (60, 60)
    row, column = np.unravel_index(error.argmax(), error.shape)
    assert 18 <= row <= 31 and 33 <= column <= 46
    assert error[:8].max() == 0


@pytest.fixture(scope="module")
def weights():
    """Random VGG-16 weights in torchvision's layout, which numbers ReLU and pooling as well."""
    torch.manual_seed(0)
    arrays, layers, place, inputs = {}, [], 0, 3
    for number, channels in enumerate(BLOCKS):
        if number:
            layers.append(nn.MaxPool2d(2))
            place += 1
        for outputs in channels:
            convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
            arrays[f"features.{place}.weight"] = convolution.weight.detach()
            arrays[f"features.{place}.bias"] = convolution.bias.detach()
            layers += [convolution, nn.ReLU()]
            place, inputs = place + 2, outputs
    return arrays, nn.Sequential(*layers)


def test_vgg_numbers_its_layers_as_torchvision_does(weights):
    assert list(weights[0])[::2] == [f"features.{n}.weight" for n in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21)]


def test_vgg_features_are_those_of_the_whole_network(weights, tmp_path):
    arrays, whole = weights
    save_file(arrays, tmp_path / "vgg.safetensors")
    torch.save(arrays, tmp_path / "vgg.pth")
    one, other = _picture(1), _picture(2)
    error = Vgg16(tmp_path / "vgg.safetensors").error_map(one, other)
    assert error.shape == (24, 32)
    assert np.array_equal(error, Vgg16(tmp_path / "vgg.pth").error_map(one, other))
    assert Vgg16(tmp_path / "vgg.pth").error_map(one, one).max() == 0

    images = [(torch.tensor(i / 255.0) - torch.tensor(MEAN)) / torch.tensor(DEVIATION) for i in (one, other)]
    images = [image.permute(2, 0, 1)[None].float() for image in images]
    expected = 0.0
    with torch.no_grad():
        for last in (3, 8, 15, 22):  # relu1_2, relu2_2, relu3_3, relu4_3 in torchvision's numbering
            a, b = (whole[: last + 1](image) for image in images)
            expected += float((a - b).square().mean())
    assert error.mean() == pytest.approx(expected, rel=1e-4)


def test_weights_that_are_not_vgg(weights, tmp_path):
    with pytest.raises(CaphyError, match="no such file"):
        Vgg16(tmp_path / "none.pth")
    (tmp_path / "junk.pth").write_bytes(b"nonsense")
    with pytest.raises(CaphyError, match="no weights that can be read"):
        Vgg16(tmp_path / "junk.pth")
    save_file({"features.0.weight": torch.zeros(64, 3, 5, 5)}, tmp_path / "other.safetensors")
    with pytest.raises(CaphyError, match=r"features\.0\.weight of shape \(64, 3, 3, 3\), got shape \(64, 3, 5, 5\)"):
        Vgg16(tmp_path / "other.safetensors")


def test_a_pickle_with_code_is_refused(tmp_path):
    import pickle

    class Harmful:
        def __reduce__(self):
            return (print, ("run",))

    (tmp_path / "bad.pth").write_bytes(pickle.dumps({"features.0.weight": Harmful()}, protocol=2))
    with pytest.raises(CaphyError, match="no weights that can be read"):
        Vgg16(tmp_path / "bad.pth")
