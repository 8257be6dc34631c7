"""Plain sentences out of the figures of a comparison, and only where the figures carry them."""

from __future__ import annotations

_NEAR_FLOOR = 1.3  # of what noise, solver, mesh and restarts explain; right models on other meshes reach it too
_NOTABLE = 1.0  # differences below this are not worth a sentence [mm]
_CHANCE = 0.05  # that any covariate at all is named where none matters


def sentences(figures: dict) -> list[str]:
    """What to know first, the most important first."""
    error, floor = figures["error"], figures["floor"]
    if error["median_mm"] is None:
        return ["Nothing was measured in the frames that the model covers."]
    said = [_headline(figures)]
    if error["median_mm"] <= _NEAR_FLOOR * floor["explained_mm"]:
        said.append(
            "These explain most of it, so that the median does not tell whether an effect is missing: caphy diagnose "
            "compares whole motions, and does."
        )
    else:
        said += [s for s in (_where(figures), _when(figures), _grows(figures), _moment(figures)) if s]
    return [*said, *_cautions(figures)]


def _headline(figures: dict) -> str:
    error, floor, prediction = figures["error"], figures["floor"], figures["prediction"]
    what = "The model's vertices" if prediction["matched_vertices"] else "The measured points"
    way = (
        f"restarted every {prediction['window_frames']} frames ({_windows(prediction)})"
        if prediction["restarted"]
        else "running freely"
    )
    of = "" if prediction["matched_vertices"] else " the model"
    text = f"{what} lie {_mm(error['median_mm'])} off{of} (median; 95 % within {_mm(error['p95_mm'])}), {way}."
    parts = []
    if floor["noise_median_mm"] is not None:
        parts.append(f"noise explains {_mm(floor['noise_median_mm'])}")
    if floor["time_step_median_mm"] is not None:
        parts.append(f"the solver's time step {_mm(floor['time_step_median_mm'])}")
    if floor["mesh_median_mm"] is not None:
        parts.append(f"its mesh {_mm(floor['mesh_median_mm'])}")
    if floor["restart_median_mm"] is not None:
        parts.append(f"restarting from what was measured {_mm(floor['restart_median_mm'])}")
    if not parts:
        return text
    listed = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"{text} Of the median, {listed}; {_mm(floor['unexplained_mm'])} are left."


def _where(figures: dict) -> str | None:
    """The worst region, if it stands out from the median, by its interval too."""
    worst, overall = figures["by_region"][0], figures["error"]["median_mm"]
    if worst["median_mm"] is None or worst["median_mm"] < max(1.2 * overall, overall + _NOTABLE):
        return None
    if worst["interval_mm"] is None or worst["interval_mm"][0] <= overall:
        return None
    text = f"Worst is the {_words(worst['region'])}: {_mm(worst['median_mm'])} off"
    low = _low(worst)
    return f"{text}, on average {low}." if low else f"{text}."


def _low(row: dict) -> str | None:
    """ "11 mm too low", where the interval of the mean excludes zero and it is a good part of the error."""
    down, span = row["down_mm"], row["down_interval_mm"]
    if down is None or span is None or span[0] <= 0 <= span[1]:
        return None
    if abs(down) < max(0.3 * row["median_mm"], _NOTABLE):
        return None
    return f"{_mm(abs(down))} too {'low' if down > 0 else 'high'}"


def _when(figures: dict) -> str | None:
    """The covariate with the largest contrast that is not the best of many by chance."""
    best, size = None, 0.0
    for row in figures["by_covariate"]:
        found = row["contrast"]
        if found is None or row["chance"] is None or found["difference_mm"] < _NOTABLE:
            continue
        if row["chance"] > _CHANCE or found["interval_mm"][0] <= 0:
            continue
        ratio = found["difference_mm"] / max(found["below_mm"], 1e-9)
        if ratio > max(size, 0.25):
            best, size = row, ratio
    if best is None:
        return None
    found = best["contrast"]
    return (
        f"The error is larger when {best['when']}: {_mm(found['above_mm'])} above {found['high']:.3g} {best['unit']}, "
        f"{_mm(found['below_mm'])} below {found['low']:.3g} {best['unit']}."
    )


def _grows(figures: dict) -> str | None:
    lags = [row for row in figures["by_lag"] if row["median_mm"] is not None]
    if len(lags) < 3 or lags[-1]["median_mm"] < 1.5 * lags[0]["median_mm"]:
        return None
    first, last = lags[0], lags[-1]
    return (
        f"From {_mm(first['median_mm'])} one frame after a restart it grows to {_mm(last['median_mm'])} after "
        f"{last['lag']} frames."
    )


def _moment(figures: dict) -> str | None:
    """The largest error as it was measured; it says nothing of other moments, so that no interval is asked for."""
    if not figures["moments"]:
        return None
    worst = figures["moments"][0]
    return (
        f"The worst moment is frame {worst['number']} ({worst['time_s']:.2f} s): the {_words(worst['region'])} is "
        f"{_mm(worst['median_mm'])} off."
    )


def _cautions(figures: dict) -> list[str]:
    prediction, error = figures["prediction"], figures["error"]
    said = [f"Caution: {each}." for each in prediction["cautions"]]
    if prediction["converged"] < 1:
        said.append(
            f"Caution: the solver did not converge in {100 * (1 - prediction['converged']):.0f} % of the frames."
        )
    if prediction["restarted"] and 0.5 ** prediction["windows"] > _CHANCE:  # that all of them agree
        said.append(f"Caution: {_windows(prediction)} cannot tell a cause from chance; measure longer.")
    if error["interval_mm"] is not None and error["interval_mm"][1] > 2 * error["interval_mm"][0]:
        low, high = error["interval_mm"]
        said.append(
            f"Parts of the motion differ much: the median lies between {_mm(low)} and {_mm(high)} with 90 % confidence."
        )
    return said


def _windows(prediction: dict) -> str:
    return f"{prediction['windows']} window{'s' * (prediction['windows'] != 1)}"


def _words(region: str) -> str:
    """ "sleeve_left" as "left sleeve"."""
    parts = region.split("_")
    if parts[-1] in ("left", "right", "front", "back"):
        parts = [parts[-1], *parts[:-1]]
    return " ".join(parts)


def _mm(value: float) -> str:
    return f"{value:.1f} mm" if value < 9.95 else f"{value:.0f} mm"
