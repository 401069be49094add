"""Observers on modes, held against a simulation by matrix exponentials."""

import numpy as np
import pytest
from scipy.linalg import expm

from pea_core.modal import ModalModel, Noises
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_observer.model import extended_state_modal, kalman_modal, kalman_rate

T_S = 50e-6
MODES = ((4643.2741, 12566.3706), (0.01, 0.01), (0.135, 0.007))


def simulate(tenths, sensor, samples):
    """True displacement, velocity and eps; y and u_applied of every sample.

    V is late by `tenths` tenths of a sample, the sensor by `sensor` samples.
    """
    steps, states = [], []
    for omega, zeta, K in zip(*MODES, strict=True):
        A = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2 * zeta * omega, K * 1e-6 * omega**2],
                      [0.0, 0.0, 0.0]])  # fmt: skip
        steps.append(expm(A * T_S / 10)[:2])
        states.append(np.zeros(2))
    way, told, rows, u = [0.0] * tenths, [0.0] * (sensor + 1), [], 0.0
    for k in range(samples):
        x1, x2 = np.sum(states, axis=0)
        told = [*told[1:], x1]
        eps = 2.0 + 300.0 * k * T_S
        rows.append((x1, x2, eps, told[0], u))
        u = 20.0 * np.sin(2 * np.pi * 90.0 * k * T_S)
        way += [u] * 10
        for _ in range(10):
            v = way.pop(0) + eps
            states = [s @ np.append(x, v) for s, x in zip(steps, states, strict=True)]
    return np.array(rows)


@pytest.mark.parametrize(("tenths", "sensor"), [(0, 0), (0, 4), (13, 3), (27, 0)])
@pytest.mark.parametrize("observer", [kalman_modal, extended_state_modal])
def test_the_present_is_estimated_whatever_is_late(observer, tenths, sensor):
    model = ModalModel(*MODES, delay=tenths * T_S / 10)
    params = observer.Params(model=model, sensor_delay_samples=sensor)
    c = observer.design(params, T_S)
    s, errors = observer.start(c), []
    for x1, x2, eps, y, u in simulate(tenths, sensor, 4000).tolist():
        measured = Measurement(y, 0.0, u)
        estimate = observer.output(c, s, measured)
        s = observer.update(c, s, measured, estimate)
        errors.append((estimate.x1 - x1, estimate.x2 - x2, estimate.eps - eps))
    last = np.abs(errors[-50:]).max(axis=0)
    # eps rises within a sample, the observer's is held: that is what is left of it
    assert last[0] < 1e-9
    assert last[1] < 1e-4
    assert last[2] < 0.02


def test_one_mode_without_delay_is_the_filter_of_eq_2():
    c = kalman_modal.design(kalman_modal.Params(estimator=Noises(0.7, 1e5, 0.0)), T_S)
    plain = kalman_rate.design(kalman_rate.Params(), T_S)
    assert [*c.L, c.l_eps, c.l_dot] == pytest.approx(
        [plain.l1, plain.l2, plain.l3, plain.l4], rel=1e-6
    )


def test_a_bandwidth_beyond_half_the_sample_rate_is_refused():
    with pytest.raises(ParameterError, match="omega_o = 70000: must be below half the sample rate"):
        extended_state_modal.design(extended_state_modal.Params(omega_o=7e4), T_S)
