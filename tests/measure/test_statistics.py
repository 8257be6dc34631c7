"""Bins, contrasts and sentences: they find what is planted and keep still where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.measure.sentences import sentences
from caphy.measure.statistics import binned, chances, contrast, interval, summary


def test_summary_is_numpys_and_ignores_holes():
    values = np.array([[0.001, np.nan], [0.003, 0.010]])
    assert summary(values) == {
        "median_mm": pytest.approx(3.0),
        "p95_mm": pytest.approx(1e3 * np.quantile([0.001, 0.003, 0.010], 0.95)),
        "count": 3,
    }
    assert summary(np.full(3, np.nan))["median_mm"] is None


def test_bins_hold_equal_numbers_and_every_value():
    random = np.random.default_rng(0)
    values, errors = random.exponential(1, (30, 40)), random.uniform(0, 1, (30, 40))
    errors[3, 4] = np.nan
    rows = binned(values, errors)
    assert len(rows) == 6
    assert sum(row["count"] for row in rows) == 1199
    assert max(row["count"] for row in rows) - min(row["count"] for row in rows) <= 1
    first = errors[(values <= rows[0]["high"]) & np.isfinite(errors)]
    assert rows[0]["median_mm"] == pytest.approx(1e3 * np.median(first), rel=0.01)


def test_contrast_finds_what_is_planted_and_not_what_is_not():
    random, window = np.random.default_rng(1), np.repeat(np.arange(10), 8)
    speed = random.uniform(0, 2, (80, 1))
    errors = np.abs(random.normal(0, 0.002, (80, 50)))
    nothing = contrast(speed, errors, window)
    assert nothing["interval_mm"][0] < 0 < nothing["interval_mm"][1]
    planted = contrast(speed, errors + 0.004 * (speed > 1.5), window)
    assert planted["difference_mm"] == pytest.approx(4.0, abs=0.3)
    assert planted["interval_mm"][0] > 3
    assert contrast(speed[:24], errors[:24], window[:24]) is None  # three windows are no evidence


@pytest.mark.parametrize("windows", [8, 15])
@pytest.mark.parametrize("of_vertices", [False, True])
def test_the_best_of_many_covariates_is_seldom_named_by_chance(windows, of_vertices):
    """Fourteen smooth covariates, none of which matters, in windows whose errors differ by 40 %."""
    random, window, tries = np.random.default_rng(0), np.repeat(np.arange(windows), 8), 150
    near = np.exp(-0.5 * ((np.arange(8 * windows)[:, None] - np.arange(8 * windows)) / 8) ** 2)
    named = real = 0
    for _ in range(tries):
        level = np.exp(random.normal(0, 0.4, windows))[window, None]
        errors = np.abs(random.normal(0, 0.003, (8 * windows, 20))) * level
        given = list((near @ random.normal(size=(8 * windows, 14))).T[..., None])
        if of_vertices:
            given = [values + 3 * random.normal(size=(1, 20)) for values in given]
        named += any(chance is not None and chance <= 0.05 for chance in chances(given, errors, window))
        turning = given[0] = random.uniform(0, 1, (8 * windows, 1))
        real += chances(given, errors * (1 + (turning > 0.7)), window)[0] <= 0.05
    assert named / tries < 0.05 + 2 * np.sqrt(0.05 * 0.95 / tries)
    assert real / tries > (0.9 if windows == 15 else 0.6)


def test_chances_of_what_is_planted():
    random, window = np.random.default_rng(1), np.repeat(np.arange(10), 8)
    speed, other = random.uniform(0, 2, (2, 80, 1))
    errors = np.abs(random.normal(0, 0.002, (80, 50))) + 0.004 * (speed > 1.5)
    found = chances([other, speed, np.ones((80, 1))], errors, window)
    assert found[1] <= 0.01 and found[0] > 0.05 and found[2] is None
    assert chances([speed[:24]], errors[:24], window[:24]) == [None]


def test_interval_respects_windows():
    """Rows of one window are copies of one draw: the interval must be that of ten draws, not of a thousand."""
    random = np.random.default_rng(0)
    draws, window = random.normal(0, 1, 10), np.repeat(np.arange(10), 100)
    values = draws[window]
    low, high = interval(lambda rows: float(values[rows].mean()), window)
    assert (high - low) / 2 == pytest.approx(1.645 * draws.std() / np.sqrt(10), rel=0.2)


def figures(**floor) -> dict:
    return {
        "error": {"median_mm": 6.0, "p95_mm": 20.0, "interval_mm": (5.0, 7.0)},
        "floor": {
            "noise_median_mm": 2.0,
            "time_step_median_mm": 0.5,
            "mesh_median_mm": 0.8,
            "restart_median_mm": 1.0,
            "explained_mm": 2.3,
            "explained_p95_mm": 6.0,
            "unexplained_mm": 5.5,
            **floor,
        },
        "prediction": {
            "matched_vertices": True,
            "restarted": True,
            "window_frames": 8,
            "windows": 9,
            "rows": 72,
            "converged": 1.0,
            "cautions": [],
        },
        "by_region": [
            {
                "region": "hem",
                "median_mm": 14.0,
                "interval_mm": (8.0, 19.0),
                "down_mm": 11.0,
                "down_interval_mm": (9.0, 13.0),
                "explained_mm": 2.3,
                "explained_p95_mm": 6.0,
            }
        ],
        "by_covariate": [
            {
                "when": "the hips turn fast",
                "unit": "°/s",
                "chance": 0.01,
                "contrast": {
                    "low": 20.0,
                    "high": 150.0,
                    "below_mm": 4.0,
                    "above_mm": 13.0,
                    "difference_mm": 9.0,
                    "interval_mm": (5.0, 12.0),
                    "noise_above_mm": 2.0,
                },
            }
        ],
        "by_lag": [],
        "moments": [],
    }


def test_sentences_say_what_the_figures_carry():
    text = " ".join(sentences(figures()))
    assert "6.0 mm off (median; 95 % within 20 mm)" in text
    assert "noise explains 2.0 mm, the solver's time step 0.5 mm, its mesh 0.8 mm and restarting" in text
    assert "Worst is the hem: 14 mm off, on average 11 mm too low." in text
    assert "larger when the hips turn fast: 13 mm above 150 °/s, 4.0 mm below 20 °/s" in text


def test_sentences_keep_still_where_they_do_not():
    given = figures()
    given["by_region"][0]["down_interval_mm"] = (-2.0, 20.0)
    given["by_covariate"][0]["contrast"]["interval_mm"] = (-1.0, 15.0)
    text = " ".join(sentences(given))
    assert "too low" not in text
    assert "turn fast" not in text
    given["by_covariate"][0]["contrast"]["interval_mm"] = (5.0, 12.0)
    for best_of_many in (0.06, None):
        given["by_covariate"][0]["chance"] = best_of_many
        assert "turn fast" not in " ".join(sentences(given))
    for chance in (None, (5.0, 25.0)):  # too few windows, or the median of all lies within
        given["by_region"][0]["interval_mm"] = chance
        assert "Worst is" not in " ".join(sentences(given))
    doubtful = figures()
    for windows, cautions in ((2, 2), (4, 2), (5, 1)):
        doubtful["prediction"] |= {"windows": windows, "converged": 0.9}
        assert sum(sentence.startswith("Caution") for sentence in sentences(doubtful)) == cautions
    doubtful["prediction"] |= {"rows": 300, "converged": 299 / 300, "window_frames": 1}
    said = sentences(doubtful)
    assert "Caution: the solver did not converge in 1 of 300 frames." in said
    assert "restarted every frame (5 windows)" in said[0]


def explained(**region) -> dict:
    """Figures of an error that noise and solver give, in the median of all and where ``region`` does not say else."""
    given = figures(explained_mm=5.5, explained_p95_mm=18.0, unexplained_mm=2.4)
    given["by_region"][0] |= {"explained_mm": 13.0, "explained_p95_mm": 25.0} | region
    given["moments"] = [{"number": 3, "time_s": 0.1, "region": "hem", "median_mm": 30.0}]
    return given


def test_an_error_that_noise_and_solver_give_is_said_to_be_that():
    quiet = sentences(explained())
    assert "the median does not tell whether an effect is missing: caphy diagnose" in quiet[1]
    assert len(quiet) == 2
    running = explained()
    running["prediction"] |= {"restarted": False, "windows": None, "window_frames": None}
    said = sentences(running)
    assert "These explain most of it" in said[1] and "diagnose" not in said[1]  # it refuses avatars


def test_what_is_wrong_in_one_place_or_moment_is_said_whatever_the_median():
    """A sleeve 20 mm too high was told as explained by noise, since the other parts are right."""
    place = sentences(explained(explained_mm=2.3))
    assert "Worst is the hem: 14 mm off, on average 11 mm too low." in place
    assert "explain most of the median, but not the largest errors" in place[1]
    moment = sentences(explained(explained_p95_mm=14.0))
    assert "The worst moment is frame 3 (0.10 s): the hem is 30 mm off." in moment
    for restarted, most in ((True, 36.0), (False, 23.4)):
        far = explained(explained_p95_mm=30.0)
        far["prediction"]["restarted"] = restarted
        for p95, sure in ((most - 0.1, True), (most + 0.1, False)):
            far["error"]["p95_mm"] = p95
            assert ("These explain most of it" in sentences(far)[1]) == sure


def test_what_noise_gives_is_no_cause():
    given = figures()
    given["by_region"][0]["explained_mm"] = 13.0
    given["by_covariate"][0]["contrast"]["noise_above_mm"] = 12.0
    text = " ".join(sentences(given))
    assert "turn fast" not in text and "Worst is" not in text
