"""Plain sentences out of the figures of a comparison, and only where the figures carry them."""

from __future__ import annotations

_NEAR_FLOOR = 1.3  # of what noise, solver, mesh and restarts explain; right models on other meshes reach it too
_NEAR_TAIL = 2.0  # of 95 %, where windows are restarted: that is told in three of them, and right models reach 1.8
_NOTABLE = 1.0  # differences below this are not worth a sentence [mm]
_CHANCE = 0.05  # that any covariate at all is named where none matters


def sentences(figures: dict) -> list[str]:
    """What to know first, the most important first."""
    error, floor = figures["error"], figures["floor"]
    if error["median_mm"] is None:
        return ["Nothing was measured in the frames that the model covers."]
    near = error["median_mm"] <= _NEAR_FLOOR * floor["explained_mm"]
    where, moment = _where(figures), _moment(figures)
    if not near:
        found = [where, _when(figures), _grows(figures), moment]
    elif where or _has_a_tail(figures):
        found = [_partly_explained(figures["prediction"]), where, moment]
    else:
        found = [_explained(figures["prediction"])]
    return [_headline(figures), *filter(None, found), *_cautions(figures)]


def _has_a_tail(figures: dict) -> bool:
    """Whether noise and solver explain fewer of the larger errors, in all or in the worst moments."""
    near = _NEAR_TAIL if figures["prediction"]["restarted"] else _NEAR_FLOOR
    floors = {row["region"]: row["explained_p95_mm"] for row in figures["by_region"]}
    found = [(figures["error"]["p95_mm"], figures["floor"]["explained_p95_mm"])]
    found += [(worst["median_mm"], floors[worst["region"]]) for worst in figures["moments"]]
    return any(distance > max(near * floor, floor + _NOTABLE) for distance, floor in found)


def _partly_explained(prediction: dict) -> str:
    text = "These explain most of the median, but not the largest errors"
    more = "; caphy diagnose compares whole motions, and tells whether an effect is missing"
    return f"{text}{more if prediction['restarted'] else ''}."


def _explained(prediction: dict) -> str:
    if not prediction["restarted"]:
        return "These explain most of it, so that the median does not tell what else is wrong."
    return (
        "These explain most of it, so that the median does not tell whether an effect is missing: caphy diagnose "
        "compares whole motions, and does."
    )


def _headline(figures: dict) -> str:
    error, floor, prediction = figures["error"], figures["floor"], figures["prediction"]
    what = "The model's vertices" if prediction["matched_vertices"] else "The measured points"
    way = (
        f"restarted every {_frames(prediction)} ({_windows(prediction)})"
        if prediction["restarted"]
        else "running freely"
    )
    of = "" if prediction["matched_vertices"] else " the model"
    text = f"{what} lie {mm(error['median_mm'])} off{of} (median; 95 % within {mm(error['p95_mm'])}), {way}."
    parts = []
    if floor["noise_median_mm"] is not None:
        parts.append(f"noise explains {mm(floor['noise_median_mm'])}")
    if floor["time_step_median_mm"] is not None:
        parts.append(f"the solver's time step {mm(floor['time_step_median_mm'])}")
    if floor["mesh_median_mm"] is not None:
        parts.append(f"its mesh {mm(floor['mesh_median_mm'])}")
    if floor["restart_median_mm"] is not None:
        parts.append(f"restarting from what was measured {mm(floor['restart_median_mm'])}")
    if not parts:
        return text
    listed = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"{text} Of the median, {listed}; {mm(floor['unexplained_mm'])} are left."


def _where(figures: dict) -> str | None:
    """The worst region that noise and solver do not explain, if it stands out from the median, by its interval too."""
    left = (row for row in figures["by_region"] if (row["median_mm"] or 0) > _NEAR_FLOOR * row["explained_mm"])
    worst, overall = next(left, None), figures["error"]["median_mm"]
    if worst is None or worst["median_mm"] < max(1.2 * overall, overall + _NOTABLE):
        return None
    if worst["interval_mm"] is None or worst["interval_mm"][0] <= overall:
        return None
    text = f"Worst is the {_words(worst['region'])}: {mm(worst['median_mm'])} off"
    low = _low(worst)
    return f"{text}, on average {low}." if low else f"{text}."


def _low(row: dict) -> str | None:
    """ "11 mm too low", where the interval of the mean excludes zero and it is a good part of the error."""
    down, span = row["down_mm"], row["down_interval_mm"]
    if down is None or span is None or span[0] <= 0 <= span[1]:
        return None
    if abs(down) < max(0.3 * row["median_mm"], _NOTABLE):
        return None
    return f"{mm(abs(down))} too {'low' if down > 0 else 'high'}"


def _when(figures: dict) -> str | None:
    """The covariate with the largest contrast that is not the best of many by chance, nor where most noise is."""
    best, size = None, 0.0
    for row in figures["by_covariate"]:
        found = row["contrast"]
        if found is None or row["chance"] is None or found["difference_mm"] < _NOTABLE:
            continue
        if row["chance"] > _CHANCE or found["interval_mm"][0] <= 0:
            continue
        if found["above_mm"] <= _NEAR_FLOOR * (found["noise_above_mm"] or 0):
            continue
        ratio = found["difference_mm"] / max(found["below_mm"], 1e-9)
        if ratio > max(size, 0.25):
            best, size = row, ratio
    if best is None:
        return None
    found = best["contrast"]
    return (
        f"The error is larger when {best['when']}: {mm(found['above_mm'])} above {found['high']:.3g} {best['unit']}, "
        f"{mm(found['below_mm'])} below {found['low']:.3g} {best['unit']}."
    )


def _grows(figures: dict) -> str | None:
    lags = [row for row in figures["by_lag"] if row["median_mm"] is not None]
    if len(lags) < 3 or lags[-1]["median_mm"] < 1.5 * lags[0]["median_mm"]:
        return None
    first, last = lags[0], lags[-1]
    return (
        f"From {mm(first['median_mm'])} one frame after a restart it grows to {mm(last['median_mm'])} after "
        f"{last['lag']} frames."
    )


def _moment(figures: dict) -> str | None:
    """The largest error as it was measured; it says nothing of other moments, so that no interval is asked for."""
    if not figures["moments"]:
        return None
    worst = figures["moments"][0]
    return (
        f"The worst moment is frame {worst['number']} ({worst['time_s']:.2f} s): the {_words(worst['region'])} is "
        f"{mm(worst['median_mm'])} off."
    )


def _cautions(figures: dict) -> list[str]:
    prediction, error = figures["prediction"], figures["error"]
    said = [f"Caution: {each}." for each in prediction["cautions"]]
    if prediction["converged"] < 1:
        failed = round((1 - prediction["converged"]) * prediction["rows"])
        said.append(f"Caution: the solver did not converge in {failed} of {prediction['rows']} frames.")
    if prediction["restarted"] and 0.5 ** prediction["windows"] > _CHANCE:  # that all of them agree
        said.append(f"Caution: {_windows(prediction)} cannot tell a cause from chance; measure longer.")
    if error["interval_mm"] is not None and error["interval_mm"][1] > 2 * error["interval_mm"][0]:
        low, high = error["interval_mm"]
        said.append(
            f"Parts of the motion differ much: the median lies between {mm(low)} and {mm(high)} with 90 % confidence."
        )
    return said


def _windows(prediction: dict) -> str:
    return f"{prediction['windows']} window{'s' * (prediction['windows'] != 1)}"


def _frames(prediction: dict) -> str:
    count = prediction["window_frames"]
    return "frame" if count == 1 else f"{count} frames"


def _words(region: str) -> str:
    """ "sleeve_left" as "left sleeve"."""
    parts = region.split("_")
    if parts[-1] in ("left", "right", "front", "back"):
        parts = [parts[-1], *parts[:-1]]
    return " ".join(parts)


def mm(value: float) -> str:
    """ "0.3 mm", "12 mm"."""
    return f"{value:.1f} mm" if value < 9.95 else f"{value:.0f} mm"
