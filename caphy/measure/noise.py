"""How much of an error is the measurement's own noise, estimated from the measurement where it does not say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi

from caphy.io.measurements import Measurement
from caphy.measure.local_fit import cubic_residuals

_MEDIAN_CHI2_3 = 2.36597 / 3  # median over mean of chi-square with 3 degrees, one for each coordinate
_CALM = 0.1  # share of the frames, the calmest, that noise is read from: fast motion is not cubic
_NEIGHBOURS = 12  # that a plane is laid through, at least
_FLAT = 5.0  # times as much scatter along the plane as across it; less is a ball of noise, no piece of cloth
_REACH = 0.04  # metres: farther apart points lie on different parts of curved cloth
_OVERSTATED = 3.0
_ENOUGH = 4000  # standard deviations that stand for all of a measurement
_UNDERSTATED, _PLAIN = 10.0, 5e-4  # times, and metres of scatter, of which brisk motion alone makes less


@dataclass(frozen=True)
class Noise:
    """Standard deviation of each coordinate [m] and where the figure comes from."""

    sigma: float
    source: str


def noise_distance(sigma: np.ndarray, coordinates: int, share: float = 0.5) -> float:
    """Distance [m] within which noise keeps a share of all points, whose coordinates have standard deviations ``sigma``
    (n,) [m].

    Args:
        coordinates: that the distance is made of: 3 between vertices, 1 across the cloth.
    """
    if sigma.min() == sigma.max():
        return float(sigma[0] * chi.ppf(share, coordinates))
    places = (np.arange(min(len(sigma), _ENOUGH)) + 0.5) * len(sigma) / min(len(sigma), _ENOUGH)
    some = np.maximum(np.sort(sigma)[places.astype(int)], 1e-9)

    def beyond(distance: float) -> float:
        return float(np.mean(chi.cdf(distance / some, coordinates))) - share

    most = 2 * float(some[-1] * chi.ppf(share, coordinates))
    return float(brentq(beyond, 0.0, most))  # pyright: ignore[reportArgumentType]


def measurement_noise(measurement: Measurement) -> Noise | None:
    """What the file states, else an estimate; none if there is too little to tell.

    Registered tracks: what cubics over five frames leave in the calmest tenth of the frames, so an upper bound
    where even those move abruptly, and blind to noise that lasts over several frames (a wrong calibration). Clouds:
    the thickness of the point set around local planes, of pieces several times as wide as thick.
    """
    if measurement.noise_mm is not None:
        return Noise(1e-3 * measurement.noise_mm, "stated in the measurement")
    if len(found := _stated(measurement)):
        return Noise(float(np.median(found)), "stated in the measurement, median over points")
    return scatter(measurement)


def deviations(measurement: Measurement) -> np.ndarray:
    """Standard deviation (n,) [m] of the coordinates of all points that were seen; one where all have the same, none
    where :func:`measurement_noise` knows none."""
    if measurement.noise_mm is None and len(found := _stated(measurement)):
        return found
    noise = measurement_noise(measurement)
    return np.zeros(0) if noise is None else np.array([noise.sigma])


def _stated(measurement: Measurement) -> np.ndarray:
    """What a file states of each point that was seen (n,) [m]."""
    if measurement.noise is None:
        return np.zeros(0)
    found = np.concatenate([np.zeros(0), *(stated_of_cloud(measurement, int(f)) for f in measurement.seen_frames)])
    return found[np.isfinite(found)]


def stated_of_cloud(measurement: Measurement, frame: int) -> np.ndarray:
    """Standard deviation (n,) [m] that a file states of each point that was seen in a frame."""
    assert measurement.noise is not None
    if measurement.registered:
        return np.broadcast_to(measurement.noise, measurement.observed.shape)[frame][measurement.observed[frame]]
    assert measurement.offsets is not None
    return measurement.noise[measurement.offsets[frame] : measurement.offsets[frame + 1]]


def overstated(measurement: Measurement) -> str | None:
    """Doubt in words where a file states far more noise than its data scatter by, which hides all that it shows."""
    stated, seen = _stated_and_seen(measurement)
    if stated <= _OVERSTATED * seen:
        return None
    return (
        f"{measurement.name} states noise of {1e3 * stated:.3g} mm but scatters by {1e3 * seen:.2g} mm; "
        "what it says is believed, and hides effects that are smaller"
    )


def understated(measurement: Measurement) -> str | None:
    """Doubt in words where a file states far less noise than its data scatter by, and noise is taken for an error."""
    stated, seen = _stated_and_seen(measurement)
    if seen <= max(_UNDERSTATED * stated, _PLAIN):
        return None
    return (
        f"{measurement.name} states noise of {1e3 * stated:.2g} mm but scatters by {1e3 * seen:.2g} mm "
        "even where it moves least; what it says is believed (noise_mm is in millimetres, noise in metres)"
    )


def _stated_and_seen(measurement: Measurement) -> tuple[float, float]:
    """Noise [m] that a file states, and what its data scatter by; zero and zero where one of them is not known."""
    stated = measurement_noise(measurement)
    seen = None if stated is None or not stated.source.startswith("stated") else scatter(measurement)
    return (0.0, 0.0) if stated is None or seen is None else (stated.sigma, seen.sigma)


def scatter(measurement: Measurement) -> Noise | None:
    """What the data themselves show of their noise; none where they are too few.

    It is too large where cloth moves or bends too sharply, and of clouds up to an eighth too small.
    """
    return _of_clouds(measurement) if measurement.vertices is None else _of_tracks(measurement)


def _of_tracks(measurement: Measurement) -> Noise | None:
    assert measurement.vertices is not None
    residual = cubic_residuals(measurement.vertices, measurement.observed)
    enough = np.isfinite(residual).sum(axis=1) >= 8
    if not enough.any():
        return None
    variance = np.nanmedian(residual[enough], axis=1) / _MEDIAN_CHI2_3
    return Noise(float(np.sqrt(np.quantile(variance, _CALM))), "estimated from cubics over five frames")


def _of_clouds(measurement: Measurement) -> Noise | None:
    variances = []
    for frame in measurement.seen_frames[:: max(len(measurement.seen_frames) // 6, 1)]:
        cloud = measurement.cloud(int(frame))
        if len(cloud) < 4 * _NEIGHBOURS:
            continue
        variances.append(_thickness(cloud))
    if np.isnan(variances).all():
        return None
    return Noise(float(np.sqrt(np.nanmedian(variances))), "estimated from the thickness of the clouds")


def _thickness(cloud: np.ndarray) -> float:
    """Variance [m^2] of points (N, 3) [m] across the cloth, N at least 48, in the median.

    Of few neighbours in a dense cloud all lie within its noise and show less than all of it: they are doubled until
    they lie flat. Where they never do, on sharply curved cloth in much noise, they are as many as lie flattest. NaN
    where already the fewest reach too far.
    """
    from scipy.spatial import KDTree

    some, tree = cloud[:: max(len(cloud) // 500, 1)], KDTree(cloud)
    best, flattest, count = np.nan, -1.0, _NEIGHBOURS
    while 4 * count <= len(cloud):
        distance, near = tree.query(some, count)
        if np.median(distance[:, -1]) > _REACH:
            break
        offset = cloud[near] - cloud[near].mean(1, keepdims=True)
        across, along, _ = np.linalg.eigvalsh(offset.swapaxes(1, 2) @ offset).T
        flat = float(np.median(along / np.maximum(across, 1e-300)))
        if flat > flattest:
            best, flattest = float(np.median(across)) / (count - 3), flat
        if flat >= _FLAT:
            break
        count *= 2
    return best
