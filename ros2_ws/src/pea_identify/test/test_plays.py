from itertools import pairwise

import numpy as np
import pytest

from pea_identify.hysteresis import moved_plays, without_creep
from pea_identify.plays import moved, plays, thresholds
from pea_identify.slow import Data, averaged, crept

R, W = np.array([0.0, 3.0, 8.0, 20.0]), 1e-7 * np.array([0.6, 0.2, 0.12, 0.08])


def triangles(*peaks, n=300):
    corners = [0.0, *(value for peak in peaks for value in (peak, 0.0))]
    rising = [np.linspace(a, b, n, endpoint=False) for a, b in pairwise(corners)]
    return np.concatenate([*rising, [0.0]])


@pytest.mark.parametrize("count", [8, 16, 24])
def test_a_stage_of_a_few_plays_is_found_as_these(count):
    u = triangles(80.0, 50.0, 70.0, 30.0)
    noise = 1e-9 * np.random.default_rng(3).standard_normal(len(u))
    every = np.ones(len(u), dtype=bool)
    data = Data(u, plays(u, R) @ W + 5e-9 + noise, every, ~every)
    r = thresholds(u, count)
    found = moved(data, r, np.full(count, W.sum() / count), 0.0)
    assert len(found.r) == len(R)
    np.testing.assert_allclose(found.r, R, atol=0.1)
    np.testing.assert_allclose(found.w, W, rtol=0.02)
    assert found.offset == pytest.approx(5e-9, abs=5e-10)


def test_averages_between_turns_lose_noise_alone():
    u = np.minimum(triangles(80.0, 50.0), 70.0)  # stops at the end of a range, too
    corners = [0, 263, 600, 1200]
    np.testing.assert_allclose(averaged(u, u, 20), u, atol=1e-12)
    noise = np.random.default_rng(4).standard_normal(len(u))
    left = averaged(u + noise, u, 20) - u
    assert left.std() < 0.35
    np.testing.assert_allclose(left[corners], noise[corners])


def test_creep_that_a_step_did_not_show_is_taken_out_of_slow_motion():
    u = triangles(80.0, 50.0, 70.0, 30.0)
    t, every = 5e-3 * np.arange(len(u)), np.ones(len(u), dtype=bool)
    v = plays(u, R) @ W
    noise = 1e-10 * np.random.default_rng(5).standard_normal(len(u))
    y = crept(v[:, None], t, np.array([0.5, 60.0]), np.array([0.02, 0.02]))[:, 0] + noise
    known = Data(u, y, every, ~every, t, np.array([0.45]), np.array([0.018]))
    left = without_creep(known, moved_plays(Data(u, v + noise, every, ~every), 8))
    one = np.column_stack([left.through(v[:, None])[:, 0], np.ones(len(v))])
    error = one @ np.linalg.lstsq(one, left.y, rcond=None)[0] - left.y
    before = one @ np.linalg.lstsq(one, known.y, rcond=None)[0] - known.y
    assert error.std() < 0.2 * before.std()
