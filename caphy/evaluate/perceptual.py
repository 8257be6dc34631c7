"""How different two pictures look: FLIP, or features of a VGG-16 network whose weights the user has."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from caphy.errors import CaphyError

BLOCKS: Final = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512))
"""Channels of VGG-16's convolutions up to relu4_3; a pooling lies between blocks."""
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet, as VGG-16 was trained with."""


class Perceptual(Protocol):
    """A perceptual error."""

    name: str
    definition: str

    def error_map(self, reference: np.ndarray, test: np.ndarray) -> np.ndarray:
        """Error (H, W) between images (H, W, 3) uint8 sRGB."""
        ...


class Flip:
    """LDR-FLIP (Andersson et al., HPG 2020) by its authors' package, at 67 pixels per degree."""

    name = "FLIP"
    definition = "LDR-FLIP (Andersson et al. 2020), 67 pixels per degree, 0 to 1"

    def error_map(self, reference: np.ndarray, test: np.ndarray) -> np.ndarray:
        """FLIP error (H, W) in 0 to 1."""
        try:
            import flip_evaluator
        except ModuleNotFoundError:
            raise CaphyError("FLIP needs its authors' package; install it with: pip install flip-evaluator") from None
        one, other = (np.ascontiguousarray(image, dtype=np.float32) / 255 for image in (reference, test))
        return flip_evaluator.evaluate(one, other, "LDR", applyMagma=False, computeMeanError=False)[0][..., 0]


class Vgg16(nn.Module):
    """Squared difference of VGG-16 features (Johnson et al., ECCV 2016) at relu1_2, 2_2, 3_3 and 4_3.

    The weights are torchvision's: keys ``features.N.weight`` and ``features.N.bias``, as safetensors or as the ``.pth``
    that torchvision hands out, of which torch reads nothing but arrays.
    """

    name = "VGG-16"
    definition = "mean squared difference of VGG-16 features at relu1_2, 2_2, 3_3 and 4_3, summed over the four"

    def __init__(self, weights: Path) -> None:
        super().__init__()
        arrays, place, inputs = _read_weights(weights), 0, 3
        blocks = []
        for number, channels in enumerate(BLOCKS):
            layers: list[nn.Module] = [nn.MaxPool2d(2)] if number else []
            place += bool(number)
            for outputs in channels:
                convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
                _fill(convolution, arrays, f"features.{place}", weights)
                layers += [convolution, nn.ReLU()]
                place, inputs = place + 2, outputs
            blocks.append(nn.Sequential(*layers))
        self.blocks = nn.ModuleList(blocks).eval()

    @torch.no_grad()
    def error_map(self, reference: np.ndarray, test: np.ndarray) -> np.ndarray:
        """Sum over the four layers of the squared feature difference (H, W), each mean over channels."""
        size = reference.shape[:2]
        features = torch.cat([_normalised(reference), _normalised(test)])
        total = torch.zeros(size)
        for block in self.blocks:
            features = block(features)
            square = (features[0] - features[1]).square().mean(0)
            total += nn.functional.interpolate(square[None, None], size, mode="bilinear", align_corners=False)[0, 0]
        return total.numpy()


def _normalised(image: np.ndarray) -> Tensor:
    pixels = torch.tensor(image, dtype=torch.float32).permute(2, 0, 1)[None] / 255
    mean, deviation = (torch.tensor(v).view(1, 3, 1, 1) for v in (MEAN, DEVIATION))
    return (pixels - mean) / deviation


def _read_weights(path: Path) -> dict[str, Tensor]:
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except FileNotFoundError:
        raise CaphyError(f"{path}: there is no such file; give VGG-16 weights, vgg16-*.pth or safetensors") from None
    except Exception as error:
        raise CaphyError(
            f"{path}: holds no weights that can be read ({type(error).__name__}); give torchvision's vgg16 as torch or "
            "safetensors write it"
        ) from error


def _fill(layer: nn.Conv2d, arrays: dict[str, Tensor], key: str, path: Path) -> None:
    for name, parameter in layer.named_parameters():
        given = arrays.get(f"{key}.{name}")
        if not isinstance(given, Tensor) or given.shape != parameter.shape:
            got = f"shape {tuple(given.shape)}" if isinstance(given, Tensor) else "nothing"
            raise CaphyError(
                f"{path}: VGG-16 must have {key}.{name} of shape {tuple(parameter.shape)}, got {got}; torchvision's "
                "vgg16 has it (not vgg16_bn)"
            )
        with torch.no_grad():
            parameter.copy_(given)
