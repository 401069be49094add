import numpy as np
import pytest

from pea_identify.peaks import resonances

F = np.arange(10.0, 8001.0, 10.0)


def response(*modes):
    s = 2j * np.pi * F
    parts = []
    for f_n, zeta, K in modes:
        w = 2.0 * np.pi * f_n
        parts.append(K * w**2 / (s**2 + 2.0 * zeta * w * s + w**2))
    return sum(parts)[:, None]


@pytest.mark.parametrize("f_n", [735.0, 737.4, 740.0])
@pytest.mark.parametrize("zeta", [0.002, 0.01, 0.03])
def test_a_peak_narrower_than_the_lines_are_apart(f_n, zeta):
    (peak,) = resonances(F, response((f_n, zeta, 1.0)))
    assert peak.omega_n / (2.0 * np.pi) == pytest.approx(f_n, abs=1.0)
    assert peak.zeta == pytest.approx(zeta, rel=0.3)


def test_the_mode_of_the_largest_gain_comes_first():
    found = resonances(F, response((639.2, 0.005, 1.0), (2003.8, 0.009, 0.05)))
    assert [round(peak.omega_n / (2.0 * np.pi)) for peak in found] == [639, 2004]


def test_a_damped_stage_has_none():
    assert resonances(F, response((700.0, 0.8, 1.0))) == []
