"""Whether a measurement can be what it says: units, axes, frame rate, order of frames, order of vertices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from caphy.io.measurements.body_checks import require_body
from caphy.io.measurements.measurement import Measurement
from caphy.io.measurements.pin_checks import require_pins

SIZE: Final = (0.02, 10.0)
"""Diagonal [m] that a piece of cloth may have in one frame."""
NOISIEST: Final = 0.2
"""Share of a cloth's size that the noise of its points does not reach."""
MAX_SPEED: Final = 40.0
"""Speed [m/s] that the median vertex of a cloth does not reach; a whip's tip does, a sheet does not."""
MOVING: Final = 0.01
"""Median step between frames, as a share of the cloth's size, from which the order of frames can be judged."""
WANDERS: Final = 0.03
"""The same for clouds, whose middle also moves with what is hidden ..."""
TURNS: Final = 0.9
"""... and its step to the next frame over that to the one after from which on they are in no order: 0.5 on a straight
path, 1 for shuffled frames."""
TELLING: Final = 50
"""Points of a cloud without which its middle tells nothing of the order: it is of other places in each frame."""
HALTED: Final = 1e-3
"""Mean step [m] before and after a frame between which a cloth does not stand perfectly still."""
ELSEWHERE: Final = 10.0
"""Sizes of a cloth from its middle beyond which nothing of it lies: what says there that it was not seen does."""
JUMP: Final = 0.05
"""Share of a cloth's size by which the median vertex of a frame is away from the middle between its neighbours ..."""
VIOLENT: Final = 200.0
"""... and the acceleration [m/s^2] which that is, that no cloth has."""
ASIDE, LIKE = 6.0, 0.25
"""Times the median over frames by which a frame out of place is away from that middle, or more, and share of this by
which its neighbours' own may differ from what it does to them."""
TORN: Final = 4.0
"""Ratio of the longest tenth of one frame's edges to the shortest, over their lengths at rest, that no cloth has."""
FAR: Final = 3.0
"""Times as long as the usual edge of a frame that the edges of a vertex are not that was seen among its neighbours."""
SHEARED: Final = 1.6
"""Ratio of the edges of one face, over their lengths in another rest shape, from which it counts as another's ..."""
WRONG: Final = 0.2
"""... and the share of such faces that no pattern has."""

_SCALES = {0.001: "millimetres", 0.01: "centimetres", 0.1: "decimetres", 0.0254: "inches", 1000.0: "kilometres"}


def require_plausible(measurement: Measurement, axes_stated: bool = True) -> None:
    """Raise :class:`CaphyError`, saying what to change, unless units, axes, rate and order are credible.

    ``axes_stated``: the file says itself which way is up, so that nothing is guessed about it.
    """
    _require_rate(measurement)
    _require_metres(measurement)
    _require_near_itself(measurement)
    _require_same_pattern(measurement)
    _require_seen(measurement)
    if measurement.registered:
        _require_same_mesh(measurement)
        _require_no_repeats(measurement)
        _require_order(measurement)
        _require_no_jump(measurement)
        _require_edges(measurement)
        require_pins(measurement)
    else:
        _require_ordered_clouds(measurement)
    require_body(measurement, axes_stated)
    if not axes_stated:
        _require_hanging(measurement)


def _require_rate(measurement: Measurement) -> None:
    if measurement.fps < 2:
        time = f"; if that is the time between frames [s], give {1 / measurement.fps:.4g}"
        raise measurement.error(
            f"fps must be frames per second, 2 or more, got {measurement.fps:g}{time if measurement.fps <= 0.5 else ''}"
        )
    if measurement.fps > 2000:
        raise measurement.error(
            f"fps must be frames per second, got {measurement.fps:g}; is it a time in another unit?"
        )


def _size(measurement: Measurement) -> float:
    """Median over frames of the diagonal of what was seen [m]."""
    frames = measurement.seen_frames[:: max(len(measurement.seen_frames) // 50, 1)]
    return float(np.median([np.linalg.norm(np.ptp(measurement.cloud(int(t)), axis=0)) for t in frames]))


def _require_metres(measurement: Measurement) -> None:
    size = _size(measurement)
    if not SIZE[0] <= size <= SIZE[1]:
        fitting = [f"{unit} (multiply by {scale:g})" for scale, unit in _SCALES.items() if 0.2 <= size * scale <= 4]
        raise measurement.error(
            f"lengths must be in metres, but the cloth measures {size:.3g} across; "
            + (f"are these {' or '.join(fitting)}?" if fitting else "check its unit"),
        )
    if measurement.noise is not None and np.nanmedian(measurement.noise) > NOISIEST * size:
        raise measurement.error(
            f"noise must be in metres, got a median of {np.nanmedian(measurement.noise):.3g} on a cloth of {size:.2g} "
            "m; divide millimetres by 1000"
        )
    if measurement.noise_mm is not None and measurement.noise_mm > 1000 * NOISIEST * size:
        raise measurement.error(
            f"noise_mm must be in millimetres, got {measurement.noise_mm:g} on a cloth of {1000 * size:.3g} mm; are "
            "these micrometres?"
        )


def _require_near_itself(measurement: Measurement) -> None:
    """No point is far from all others: programs also write -9999 for what was not seen."""
    limit = ELSEWHERE * _size(measurement)
    for frame in map(int, measurement.seen_frames):
        cloud = measurement.cloud(frame)
        away = np.abs(cloud - np.median(cloud, axis=0)).max(axis=1)
        if away.max() > limit:
            place = int(np.argmax(away))
            if measurement.registered:
                place = int(np.flatnonzero(measurement.observed[frame])[place])
            what, remedy = ("vertex", "NaN") if measurement.registered else ("point", "out")
            raise measurement.error(
                f"{what} {place} lies {away.max():.3g} m away from the others in frame {measurement.number(frame)} "
                f"({(away > limit).sum()} such there): leave what was not seen {remedy}"
            )


def _pair(measurement: Measurement, frames: Sequence[int] | np.ndarray) -> str:
    first, second = map(measurement.number, frames)
    return f"{first} and {second}"


def mesh_edges(faces: np.ndarray) -> np.ndarray:
    """The edges (E, 2) of triangles, each once."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0)


def edges_at_rest(measurement: Measurement) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The ends (E,), (E,) of a registered mesh's edges and their lengths at rest (E,) [m]; none without a rest mesh."""
    if measurement.rest_vertices is None or measurement.vertices is None or measurement.faces is None:
        return None
    a, b = mesh_edges(measurement.faces).T
    return a, b, np.linalg.norm(measurement.rest_vertices[a] - measurement.rest_vertices[b], axis=1)


def _require_edges(measurement: Measurement) -> None:
    """No edge of the rest mesh has its ends in one place."""
    if (known := edges_at_rest(measurement)) is None:
        return
    a, b, rest = known
    short = np.flatnonzero(rest < 1e-6 * _size(measurement))
    if len(short):
        raise measurement.error(
            f"rest_vertices {a[short[0]]} and {b[short[0]]} lie on one another and an edge joins them ({len(short)} "
            "such edges in all); merge them, or put one right"
        )


def _require_same_pattern(measurement: Measurement) -> None:
    """Edges must be about as long in the flat rest shapes as in the rest mesh."""
    if measurement.rest_vertices is None or measurement.material is None or measurement.faces is None:
        return
    corners, flat = measurement.rest_vertices[measurement.faces], measurement.material
    rest, laid = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=-1) for x in (corners, flat))
    low, middle, high = np.quantile(laid / np.maximum(rest, 1e-12), (0.1, 0.5, 0.9))
    if not 0.5 <= middle <= 2 or high > 2.5 * low:
        raise measurement.error(
            f"edges are {low:.2g} to {high:.2g} times as long in material as in rest_vertices (in the median "
            f"{middle:.3g}); give both in metres, and material's corners in the order of faces"
        )
    ratio = laid / np.maximum(rest, 1e-12)
    wrong = float((ratio.max(axis=1) > SHEARED * ratio.min(axis=1)).mean())
    if wrong > WRONG:
        raise measurement.error(
            f"{100 * wrong:.0f} % of the faces have another shape in material than in rest_vertices; give material's "
            "corners in the order of faces and of each face's corners"
        )


def _require_seen(measurement: Measurement) -> None:
    """What was not seen is left out: programs that write zeros put it all at the origin."""
    if measurement.vertices is None:
        assert measurement.points is not None
        at = np.flatnonzero((measurement.points == 0).all(axis=1))
        frame = np.searchsorted(measurement.offsets, at, side="right") - 1  # pyright: ignore
        counts = np.bincount(frame, minlength=len(measurement))
        if counts.max() > 1:
            raise measurement.error(
                f"frame {measurement.number(counts.argmax())} has {counts.max()} points at (0, 0, 0); leave points "
                "that were not seen out of the cloud"
            )
        return
    at = measurement.observed & (measurement.vertices == 0).all(axis=-1)
    if measurement.pinned is not None:
        at[:, measurement.pinned] = False
    for frame in np.flatnonzero(at.any(axis=1)):
        zeros = np.flatnonzero(at[frame])
        if len(zeros) > 1 or _torn_off(measurement, int(frame), int(zeros[0])):
            many = int(at.sum())
            raise measurement.error(
                f"vertex {zeros[0]} lies at (0, 0, 0) in frame {measurement.number(frame)}, away from its neighbours "
                f"({many} such places): leave what was not seen NaN"
            )


def _torn_off(measurement: Measurement, frame: int, vertex: int) -> bool:
    """Whether most edges of a vertex are far longer than the mesh's usually are in that frame."""
    assert measurement.vertices is not None
    assert measurement.faces is not None
    pairs = mesh_edges(measurement.faces)
    length = np.linalg.norm(np.diff(measurement.vertices[frame][pairs], axis=1)[:, 0], axis=-1)
    known = np.isfinite(length)
    own = known & (pairs == vertex).any(axis=1)
    return bool(own.any() and np.median(length[own]) > FAR * np.median(length[known]))


def _noisy(measurement: Measurement) -> bool:
    """Whether it states a noise."""
    return bool(measurement.noise_mm) or (measurement.noise is not None and bool(np.nanmax(measurement.noise) > 0))


def _require_no_repeats(measurement: Measurement) -> None:
    """With noise no frame is the same as the one before to the last digit; without, none amid a motion."""
    if measurement.vertices is None:
        return
    noisy, frames = _noisy(measurement), measurement.seen_frames
    now, before = measurement.seen_vertices[frames[1:]], measurement.seen_vertices[frames[:-1]]
    same = ((now == before) | (np.isnan(now) & np.isnan(before))).all(axis=(1, 2))
    if not noisy:
        apart = np.linalg.norm(now - before, axis=2)
        moving = np.nansum(apart, axis=1) > HALTED * np.isfinite(apart).sum(axis=1)
        same &= np.append(moving[1:], False) & np.append(False, moving[:-1])
    pairs = np.flatnonzero(same)
    if len(pairs):
        first = int(pairs[0])
        raise measurement.error(
            f"frames {_pair(measurement, frames[first : first + 2])} are the same to the last digit, "
            f"{'in spite of noise' if noisy else 'while the cloth moves before and after'} ({len(pairs)} such pairs): "
            "leave repeated frames empty (NaN), and give the true fps"
        )


def _require_same_mesh(measurement: Measurement) -> None:
    """Edges must be about as long as at rest: cloth does not stretch twofold, nor do vertices change places."""
    if (known := edges_at_rest(measurement)) is None:
        return
    a, b, rest = known
    frames = measurement.seen_frames
    each = [_lengths_over(measurement.seen_vertices[frame], a, b, rest) for frame in frames]
    ratio = np.concatenate(each[:: max(len(frames) // 20, 1)])
    if len(ratio) == 0:
        return
    low, middle, high = np.quantile(ratio, (0.1, 0.5, 0.9))
    if high > 2.5 * low:
        raise measurement.error(
            f"some edges are {low:.2g} and others {high:.2g} times as long as at rest: faces, rest_vertices and "
            "vertices are not in the same vertex order. Export all three from one mesh"
        )
    if not 0.5 <= middle <= 2:
        large = middle if middle > 1 else 1 / middle
        unit = min(_SCALES, key=lambda scale: abs(np.log(large * scale)))
        wrong, right = ("vertices", "a rest mesh") if middle > 1 else ("rest_vertices", "frames")
        advice = f"the {wrong} look like {_SCALES[unit]} beside {right} in metres: multiply them by {unit:g}"
        fits = 0.5 <= large * unit <= 2
        raise measurement.error(
            f"edges are {middle:.3g} times as long as in rest_vertices; "
            + (advice if fits else "are both in metres, and of the same mesh?"),
        )
    for frame, own in zip(frames, each, strict=True):
        low, high = np.quantile(own, (0.1, 0.9)) if len(own) else (1.0, 1.0)
        if high > TORN * low:
            raise measurement.error(
                f"in frame {measurement.number(frame)} some edges are {low:.2g} and others {high:.2g} times as long as "
                "at rest: its vertices are in another order than other frames'; export all from one mesh, or leave it "
                "empty (NaN)"
            )


def _lengths_over(x: np.ndarray, a: np.ndarray, b: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Lengths of the edges whose ends were seen, over those at rest."""
    ratio = np.linalg.norm(x[a] - x[b], axis=1) / np.maximum(rest, 1e-12)
    return ratio[np.isfinite(ratio)]


def _step(measurement: Measurement, frames: np.ndarray, lag: int) -> np.ndarray:
    """Median distance (n,) [m] that vertices move from each frame to the one ``lag`` later in the list."""
    moved = measurement.seen_vertices[frames[lag:]] - measurement.seen_vertices[frames[:-lag]]
    distance = np.linalg.norm(np.where(np.isfinite(moved), moved, 0), axis=-1)
    seen = measurement.observed[frames[lag:]] & measurement.observed[frames[:-lag]]
    return np.array([np.median(d[s]) if s.any() else 0.0 for d, s in zip(distance, seen, strict=True)])


def _require_order(measurement: Measurement) -> None:
    """Frames in the order of time: of three neighbours the outer two are farthest apart, but for noise."""
    frames = measurement.seen_frames
    if len(frames) < 6:
        return
    size, one = _size(measurement), _step(measurement, frames, 1)
    gap = np.diff(frames)
    speed = one * measurement.fps / gap
    if np.median(speed) > MAX_SPEED:
        raise measurement.error(
            f"the cloth moves at {np.median(speed):.0f} m/s through half of the frames; are the frames in order, and "
            f"is fps = {measurement.fps:g} the true rate?"
        )
    two = _step(measurement, frames, 2)
    # Four frames a b c d: if a c b d is a much shorter way, b and c are not in the order of time.
    ordered, swapped = one[:-2] + one[1:-1] + one[2:], two[:-1] + one[1:-1] + two[1:]
    steady = (gap[:-2] == 1) & (gap[1:-1] == 1) & (gap[2:] == 1)
    wrong = steady & (ordered > 1.5 * swapped) & (one[1:-1] > MOVING * size)
    if not wrong.any():
        return
    first = int(frames[np.argmax(wrong) + 1])
    if wrong.sum() == 1:
        raise measurement.error(
            f"frames {_pair(measurement, (first, first + 1))} look exchanged; put the frames in the order of time"
        )
    raise measurement.error(
        f"the frames look shuffled, first at frames {_pair(measurement, (first, first + 1))}: the way through them "
        "becomes much shorter when neighbours are exchanged. Sort them by time (frame_2, frame_10 sort wrongly as text)"
    )


def _require_ordered_clouds(measurement: Measurement) -> None:
    """Clouds in the order of time, each once: place and extent change less to the next frame than to the one after."""
    frames = measurement.seen_frames
    clouds = [measurement.cloud(int(frame)) for frame in frames]
    same = np.array([np.array_equal(now, before) for now, before in zip(clouds[1:], clouds[:-1], strict=True)], bool)
    if not _noisy(measurement):  # simulated cloth may stand still, but not for one frame amid a motion
        same &= np.append(~same[1:], False) & np.append(False, ~same[:-1])
    if same.any():
        first = int(same.argmax())
        raise measurement.error(
            f"frames {_pair(measurement, frames[first : first + 2])} are the same to the last digit ({same.sum()} such "
            "pairs): leave repeated frames empty, and give the true fps"
        )
    clouds = [cloud for cloud in clouds if len(cloud) >= TELLING]
    if len(clouds) < 6:
        return
    told = np.array([np.concatenate([cloud.mean(axis=0), cloud.std(axis=0)]) for cloud in clouds])
    one, two = (float(np.median(np.linalg.norm(told[lag:] - told[:-lag], axis=1))) for lag in (1, 2))
    if one > WANDERS * _size(measurement) and one > TURNS * two:
        raise measurement.error(
            f"the frames look shuffled: clouds move {one / two:.2g} times as far to the next frame as to the one "
            "after. Sort them by time (frame_2, frame_10 sort wrongly as text)"
        )


def _require_no_jump(measurement: Measurement) -> None:
    """No single frame lies elsewhere than those around it, or is of another size or order."""
    frames = measurement.seen_frames
    if len(frames) < 6 or measurement.vertices is None:
        return
    x = measurement.seen_vertices[frames]
    between = np.linalg.norm(x[1:-1] - 0.5 * (x[:-2] + x[2:]), axis=-1)
    known = np.isfinite(between).any(axis=1) & (np.diff(frames)[:-1] == 1) & (np.diff(frames)[1:] == 1)
    away = np.zeros(len(between))
    away[known] = np.nanmedian(between[known], axis=1)
    worst = int(np.argmax(away))
    violent = away[worst] >= JUMP * _size(measurement) and 2 * away[worst] * measurement.fps**2 >= VIOLENT
    if not violent and not _alone(x, known, away, worst):
        return
    place, by = worst + 1, away[worst]
    if worst == 0 and away[1] < 0.25 * by:  # it is the first frame that is wrong, not the second
        place, by = 0, 2 * by
    elif worst == len(away) - 1 and away[-2] < 0.25 * by:
        place, by = len(frames) - 1, 2 * by
    raise measurement.error(
        f"frame {measurement.number(frames[place])} lies elsewhere than the frames around it say, by {by:.2g} m in the "
        "median of its vertices; put its unit, place and order right, or leave it empty (NaN)"
    )


def _alone(x: np.ndarray, known: np.ndarray, away: np.ndarray, worst: int) -> bool:
    """Whether one frame of tracks (T, V, 3) [m] lies aside by itself, far more than most.

    Cloth that is pushed goes on from where it is; only a frame out of place leaves its neighbours half as far off, the
    other way.

    Args:
        known: of frames 1 to T - 2, which have neighbours (T - 2,).
        away: how far each is from the middle between them [m].
        worst: which of those is farthest.
    """
    if not 0 < worst < len(away) - 1 or not known[worst - 1 : worst + 2].all():
        return False
    if away[worst] < ASIDE * np.median(away[known]):
        return False
    aside = x[1:-1][worst - 1 : worst + 2] - 0.5 * (x[:-2] + x[2:])[worst - 1 : worst + 2]
    left = np.linalg.norm(aside[[0, 2]] + 0.5 * aside[1], axis=-1)
    return bool((np.nanmedian(left, axis=1) < LIKE * away[worst]).all())


def _require_hanging(measurement: Measurement) -> None:
    """On pins the cloth hangs below them; if it hangs along -z instead, z is up."""
    if measurement.pinned_positions is None:
        return
    frames = measurement.seen_frames
    hanging = np.median(
        [measurement.cloud(int(t)).mean(0) - measurement.pinned_positions[t].mean(0) for t in frames], axis=0
    )
    length = float(np.linalg.norm(hanging))
    if length > 0.1 * _size(measurement) and hanging[1] > 0.8 * length:
        raise measurement.error(
            "the cloth hangs upwards from its pins; turn it, or state up_axis = 'y' in the file if it does fly so"
        )
    if length > 0.1 * _size(measurement) and hanging[1] > -0.3 * length and abs(hanging[0]) > 0.8 * length:
        raise measurement.error(
            f"the cloth hangs along {'-' if hanging[0] < 0 else ''}x from its pins, so that axes seem to be exchanged; "
            "turn it, or state up_axis = 'y' in the file if it does fly that way"
        )
    if length > 0.1 * _size(measurement) and hanging[1] > -0.3 * length and hanging[2] < -0.8 * length:
        raise measurement.error(
            "the cloth hangs along -z from its pins, so z seems to be up; state up_axis = 'z' in the file (or "
            "up_axis = 'y' if it does fly that way)"
        )
