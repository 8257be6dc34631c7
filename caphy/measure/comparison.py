"""One model against one measurement: every figure, ready for JSON, and the fields behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.io.measurements import Measurement
from caphy.measure.covariates import Covariate, covariates
from caphy.measure.errors import Errors, SurfaceErrors, picked, surface_errors, vertex_errors
from caphy.measure.noise import measurement_noise, noise_distance, stated_of_cloud
from caphy.measure.prediction import Prediction
from caphy.measure.remarks import remarks
from caphy.measure.sentences import sentences
from caphy.measure.statistics import MILLI, binned, chances, contrast, interval, mean_mm, summary

WORST = 4
"""Worst moments that are reported."""
APART = 5
"""Frames that two reported moments are apart at least."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Figures (JSON) and the fields they come from.

    ``errors`` are those of the vertices, to be looked at; of clouds they are means of the points around each, with less
    noise than the points have whose distances the figures are of.
    """

    figures: dict
    prediction: Prediction
    measurement: Measurement
    errors: Errors
    regions: np.ndarray


def compare(prediction: Prediction, measurement: Measurement, names: np.ndarray | None = None) -> Comparison:
    """Compare what a model predicts with what was measured; ``names`` (V,) are the regions of the model's mesh."""
    surface = surface_errors(prediction, measurement)
    errors = vertex_errors(prediction, measurement) if prediction.registered else surface.of_points
    regions = region_names(prediction, names)
    found = covariates(prediction, measurement)
    sigma = _sigma(prediction, measurement, errors)
    figures = {
        "measurement": _about(measurement, prediction),
        "prediction": _prediction(prediction),
        "error": _overall(errors, surface, prediction),
        "floor": _floor(prediction, measurement, errors, sigma),
        "by_frame": _by_frame(prediction, errors, surface, measurement),
        "by_lag": _by_lag(prediction, errors),
        "by_region": _by_region(prediction, errors, regions, sigma),
        "by_covariate": _by_covariate(found, errors, prediction, sigma),
        "moments": _moments(prediction, measurement, errors, regions),
    }
    figures["sentences"] = sentences(figures)
    shown = errors if prediction.registered else surface.of_vertices
    return Comparison(figures, prediction, measurement, shown, regions)


def region_names(prediction: Prediction, names: np.ndarray | None) -> np.ndarray:
    """The given names (V,), or thirds by height where there are none."""
    if names is not None and len(np.unique(names)) > 1:
        return names
    height = prediction.vertices[..., 1].mean(axis=0)
    third = np.searchsorted(np.quantile(height, (1 / 3, 2 / 3)), height)
    return np.array(["lower third", "middle third", "upper third"])[third]


def _about(measurement: Measurement, prediction: Prediction) -> dict:
    return {
        "name": measurement.name,
        "source": measurement.source,
        "fps": measurement.fps,
        "frames": len(measurement),
        "numbering": list(measurement.numbering),
        "frames_seen": len(measurement.seen_frames),
        "registered": measurement.registered,
        "holes": float(1 - measurement.observed[measurement.seen_frames].mean()) if measurement.registered else None,
        "notes": list(measurement.notes),
        "remarks": remarks([measurement], every_frame=prediction.lag is None),
    }


def _prediction(prediction: Prediction) -> dict:
    return {
        "rows": len(prediction.frames),
        "restarted": prediction.lag is not None,
        "windows": len(np.unique(prediction.window)) if prediction.lag is not None else None,
        "window_frames": int(prediction.lag.max()) if prediction.lag is not None else None,
        "matched_vertices": prediction.registered,
        "converged": float(prediction.converged.mean()),
        "cautions": list(prediction.cautions),
    }


def _overall(errors: Errors, surface: SurfaceErrors, prediction: Prediction) -> dict:
    signed = np.concatenate(surface.signed)
    return {
        **summary(errors.distance),
        "interval_mm": _median_interval(errors.distance, prediction.window),
        "normal_median_mm": summary(np.abs(errors.normal))["median_mm"],
        "normal_mean_mm": mean_mm(errors.normal),
        "along_median_mm": summary(errors.along)["median_mm"],
        "down_mean_mm": mean_mm(errors.down),
        "surface_median_mm": summary(np.abs(signed))["median_mm"],
        "surface_p95_mm": summary(np.abs(signed))["p95_mm"],
        "surface_signed_mean_mm": mean_mm(signed),
        "chamfer_mm": mean_mm(surface.chamfer),
    }


def _median_interval(distance: np.ndarray, window: np.ndarray) -> tuple[float, float] | None:
    if len(np.unique(window)) < 4 or not np.isfinite(distance).any():
        return None
    found = [row[np.isfinite(row)] for row in distance]
    return interval(lambda rows: MILLI * float(np.median(np.concatenate([found[row] for row in rows]))), window)


def _sigma(prediction: Prediction, measurement: Measurement, errors: Errors) -> np.ndarray | None:
    """Standard deviation of the noise of each coordinate where errors are (N, P) [m]; none where none is known."""
    noise = measurement_noise(measurement)
    if noise is None:
        return None
    same = np.full(errors.distance.shape, noise.sigma)
    if measurement.noise is None:
        return same
    found = np.full(errors.distance.shape, np.nan)
    for row, frame in zip(found, prediction.frames, strict=True):
        stated = stated_of_cloud(measurement, int(frame))
        if prediction.registered:
            row[measurement.observed[frame]] = stated
        else:
            row[: len(picked(stated))] = picked(stated)
    return found if np.isfinite(found).any() else same


def _expected(sigma: np.ndarray | None, counted: np.ndarray, prediction: Prediction, share: float) -> float | None:
    """How far off [mm] noise leaves a share of the errors that count (N, P); none where none is known.

    Of a distance to a surface only the noise across it counts."""
    known = np.zeros(0) if sigma is None else sigma[counted & np.isfinite(sigma)]
    return MILLI * noise_distance(known, 3 if prediction.registered else 1, share) if len(known) else None


def _parts(prediction: Prediction, vertices: np.ndarray | None = None) -> dict[str, dict]:
    """What time step, mesh and restarts do to vertices (V,), all unless given, in summary; those that were told."""
    given = {"time_step": prediction.step_error, "mesh": prediction.mesh_error, "restart": prediction.start_error}
    return {
        name: summary(error if vertices is None else error[:, vertices])
        for name, error in given.items()
        if error is not None
    }


def _floor(prediction: Prediction, measurement: Measurement, errors: Errors, sigma: np.ndarray | None) -> dict:
    """What noise, time step, mesh and restarts explain of the median, and what they leave, in quadrature."""
    noise, parts, counted = measurement_noise(measurement), _parts(prediction), np.isfinite(errors.distance)
    expected, total = _expected(sigma, counted, prediction, 0.5), summary(errors.distance)["median_mm"]
    explained = _together(expected, parts, "median_mm")
    left = None if total is None else max(total**2 - explained**2, 0) ** 0.5
    return {
        "noise_sigma_mm": None if noise is None else MILLI * noise.sigma,
        "noise_source": None if noise is None else noise.source,
        "noise_median_mm": expected,
        **{f"{name}_median_mm": parts.get(name, {}).get("median_mm") for name in ("time_step", "mesh", "restart")},
        "explained_mm": explained,
        "explained_p95_mm": _together(_expected(sigma, counted, prediction, 0.95), parts, "p95_mm"),
        "unexplained_mm": left,
    }


def _together(noise: float | None, parts: dict[str, dict], name: str) -> float:
    """In quadrature."""
    return sum((each or 0) ** 2 for each in (noise, *(part[name] for part in parts.values()))) ** 0.5


def _by_frame(prediction: Prediction, errors: Errors, surface: SurfaceErrors, measurement: Measurement) -> dict:
    rows = [summary(row) for row in errors.distance]
    return {
        "frame": prediction.frames.tolist(),
        "number": [measurement.number(frame) for frame in prediction.frames],
        "median_mm": [row["median_mm"] for row in rows],
        "p95_mm": [row["p95_mm"] for row in rows],
        "chamfer_mm": [None if np.isnan(c) else MILLI * float(c) for c in surface.chamfer],
        "window": prediction.window.tolist(),
    }


def _by_lag(prediction: Prediction, errors: Errors) -> list[dict]:
    if prediction.lag is None:
        return []
    return [{"lag": int(k), **summary(errors.distance[prediction.lag == k])} for k in np.unique(prediction.lag)]


def _by_region(prediction: Prediction, errors: Errors, regions: np.ndarray, sigma: np.ndarray | None) -> list[dict]:
    """Regions from the worst to the best."""
    rows = []
    for name in np.unique(regions):
        part = (regions == name)[errors.vertex]
        counted, parts = part & np.isfinite(errors.distance), _parts(prediction, regions == name)
        distance, down = (np.where(part, values, np.nan) for values in (errors.distance, errors.down))
        rows.append(
            {
                "region": str(name),
                **summary(distance),
                "interval_mm": _median_interval(distance, prediction.window),
                "normal_mm": mean_mm(errors.normal[part]),
                "along_mm": summary(errors.along[part])["median_mm"],
                "down_mm": mean_mm(down),
                "down_interval_mm": _mean_interval(down, prediction.window),
                "explained_mm": _together(_expected(sigma, counted, prediction, 0.5), parts, "median_mm"),
                "explained_p95_mm": _together(_expected(sigma, counted, prediction, 0.95), parts, "p95_mm"),
            }
        )
    return sorted(rows, key=lambda row: -(row["median_mm"] or 0))


def _mean_interval(values: np.ndarray, window: np.ndarray) -> tuple[float, float] | None:
    if len(np.unique(window)) < 4 or not np.isfinite(values).any():
        return None
    total, count = np.nansum(values, axis=1), np.isfinite(values).sum(axis=1)
    return interval(lambda rows: MILLI * float(total[rows].sum() / max(count[rows].sum(), 1)), window)


def _by_covariate(
    found: list[Covariate], errors: Errors, prediction: Prediction, sigma: np.ndarray | None
) -> list[dict]:
    """What the error depends on, each alone; ``chance``: how often the best of all would show as much by chance."""
    values = [_at_errors(covariate.values, errors, prediction) for covariate in found]
    rows = [
        {
            "name": covariate.name,
            "unit": covariate.unit,
            "when": covariate.when,
            "bins": binned(each, errors.distance),
            "contrast": contrast(each, errors.distance, prediction.window),
            "chance": chance,
        }
        for covariate, each, chance in zip(
            found, values, chances(values, errors.distance, prediction.window), strict=True
        )
    ]
    for row, each in zip(rows, values, strict=True):
        if (known := row["contrast"]) is not None:
            above = np.isfinite(errors.distance) & (each > known["high"])
            known["noise_above_mm"] = _expected(sigma, above, prediction, 0.5)
    return rows


def _at_errors(values: np.ndarray, errors: Errors, prediction: Prediction) -> np.ndarray:
    """Values (N, V) of the vertices where errors (N, P) are; what belongs to whole rows (N, 1) as it is."""
    if values.shape[1] == 1:
        return values
    return np.take_along_axis(np.broadcast_to(values, prediction.vertices.shape[:2]), errors.vertex, axis=1)


def _moments(prediction: Prediction, measurement: Measurement, errors: Errors, regions: np.ndarray) -> list[dict]:
    """The worst pairs of frame and region, apart in time, the worst first."""
    names = np.unique(regions)
    parts = [(regions == name)[errors.vertex] for name in names]
    medians = [
        [summary(row[at])["median_mm"] or 0.0 for row, at in zip(errors.distance, part, strict=True)] for part in parts
    ]
    table = np.stack(medians, axis=1)  # (N, R)
    found: list[dict] = []
    for place in np.argsort(-table, axis=None):
        row, region = np.unravel_index(place, table.shape)
        frame = int(prediction.frames[row])
        if table[row, region] == 0 or len(found) == WORST:
            break
        if all(abs(frame - other["frame"]) >= APART for other in found):
            part = parts[region][row]
            found.append(
                {
                    "frame": frame,
                    "number": measurement.number(frame),
                    "row": int(row),
                    "time_s": frame / measurement.fps,
                    "region": str(names[region]),
                    "median_mm": float(table[row, region]),
                    "down_mm": mean_mm(errors.down[row, part]),
                    "normal_mm": mean_mm(errors.normal[row, part]),
                }
            )
    return found
