"""The complementary sensitivity of a velocity loop, measured on the physics, and where learning is safe in it.

Feedback-error learning lowers U_fb by adding to U_ff, so it depends on the response of U_fb to U_ff:
∂U_fb/∂U_ff = −T with T = L/(1 + L), where L is the loop opened at the voltage. Learning converges at frequencies where
Re T(jω) > 0, whatever the regressor (Gomi and Kawato 1993), and with the regressor of τ ago where Re [T e^(jωτ)] > 0
(Morgan 1980). T is measured in the complete loop by a feedforward that does not learn and adds a multisine to the
voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mrctl.control.feedforward import STEERING_SCALE
from mrctl.control.guard import Guard
from mrctl.control.matching import HOLD_PERIODS
from mrctl.kernel import Array
from mrctl.loop.groups import arranged
from mrctl.loop.hierarchy import HAND_OVER_SHARE
from mrctl.loop.simulation import Simulation
from mrctl.record import InputError
from mrctl.scenario import FEEDFORWARDS, Scenario
from mrctl.theory.references import Line

Response = NDArray[np.complex128]

PERIOD_TICKS = 1000  # control periods in a period of the excitation
AMPLITUDE = 0.03  # V at each frequency, times `STEERING_SCALE` in rad/s for steering: no tyre slides, no wheel reverses


def lines(samples: int) -> NDArray[np.intp]:
    """Returns the odd harmonics below the Nyquist frequency; a quadratic nonlinearity responds only at even ones."""
    return np.arange(1, samples // 2, 2)


def multisine(samples: int, harmonics: NDArray[np.intp]) -> Array:
    """Returns one period of a sum of harmonics of amplitude 1 with Schroeder's phases (1970), which keep its peak low.

    Args:
        samples: Number of samples in the period.
        harmonics: The harmonics, `(F,)`.

    Returns:
        The signal, `(samples,)`.
    """
    k = np.arange(len(harmonics))
    angle = 2 * np.pi * np.outer(np.arange(samples), harmonics) / samples - np.pi * k * (k + 1) / len(harmonics)
    return np.cos(angle).sum(axis=1)


def estimate(excitation: Array, answer: Array, harmonics: NDArray[np.intp]) -> Response:
    """Estimates the frequency response of a system in periodic steady state, exactly if it is linear.

    Args:
        excitation: One period of the input, `(N,)`.
        answer: The same period of the output, `(N, …)`.
        harmonics: Harmonics of the input, `(F,)`.

    Returns:
        The complex response at the harmonics, `(…, F)`.
    """
    return np.moveaxis(np.fft.rfft(answer, axis=0)[harmonics], 0, -1) / np.fft.rfft(excitation)[harmonics]


class Shaker:
    """A feedforward stage that repeats a signal and records the feedback.

    Attributes:
        feedback: Feedback in each tick, `(ticks, B, 2)`, in the units of the channels.
    """

    def __init__(self, signal: Array, ticks: int, size: int) -> None:
        """Takes one period of the signal `(N, 2)`, the length of the run and the number of robots."""
        self._signal = np.repeat(signal[:, None], size, axis=1)
        self._tick = 0
        self.feedback = np.zeros((ticks, size, 2))

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the signal at this tick, `(B, 2)`."""
        return self._signal[self._tick % len(self._signal)]

    def learn(self, feedback: Array, frozen: Array, twist: Array, voltage: Array) -> None:
        """Records the feedback."""
        self.feedback[self._tick] = feedback
        self._tick += 1


def measure(scenarios: Sequence[Scenario], channel: int, speed: float = Line().speed) -> tuple[Array, Response]:
    """Measures T of one channel on robots that drive straight on, in the complete loop with hold, delay and tyres.

    With zero gains of the motion controller this is T of the velocity loop alone; with its usual gains it is T of the
    loop in which learning takes place.

    Args:
        scenarios: Runs that fit one batch; their references, feedforwards, events and guards are replaced.
        channel: 0 for the common channel, 1 for the differential or the steering channel.
        speed: Speed of the robots in m/s.

    Returns:
        ω in rad/s `(F,)` and T `(B, F)`.

    Raises:
        InputError: A robot failed.
    """
    first = arranged(scenarios[0])
    harmonics = lines(PERIOD_TICKS)
    signal = np.zeros((PERIOD_TICKS, 2))
    scale = STEERING_SCALE if channel == 1 and first.steering == "rigid" else 1.0
    signal[:, channel] = AMPLITUDE * scale * multisine(PERIOD_TICKS, harmonics)
    duration = 2 * PERIOD_TICKS * first.control_period  # one period to settle, one to measure
    line = Line(length=speed * duration, speed=speed)
    steady = {"reference": line, "laps": 1, "events": (), "initial_spread": (0.0, 0.0, 0.0), "guard": Guard(on=False)}
    steady |= FEEDFORWARDS["none"]
    runs = [s.model_copy(update=steady | {"pid": s.pid.model_copy(update={"retune": False})}) for s in scenarios]
    shaker = Shaker(signal, 2 * PERIOD_TICKS, len(runs))
    simulation = Simulation(runs, feedforward=lambda robot, size: shaker)
    while simulation.running:
        simulation.step()
    for row in np.flatnonzero(simulation.plant.stopped):
        raise InputError(f"world: no response on {line.length:g} m of it: {simulation.plant.failure[row]}")
    response = -estimate(signal[:, channel], shaker.feedback[PERIOD_TICKS:, :, channel], harmonics)
    return 2 * np.pi / (PERIOD_TICKS * first.control_period) * harmonics.astype(float), response


def refine(frequency: Array, response: Response) -> tuple[Array, Response]:
    """Interpolates a response by cubic splines on a fine grid that is evenly spaced in the logarithm of frequency."""
    fine = np.geomspace(frequency[0], frequency[-1], 4000)
    real, imaginary = CubicSpline(frequency, np.stack([response.real, response.imag]), axis=1)(fine)
    return fine, real + 1j * imaginary


class Safety(NamedTuple):
    """Frequencies and steps at which learning is safe in a loop.

    With a constant regressor a learner of normalised step μ is an integrator, U_ff(k + 1) = U_ff(k) + μ U_fb(k), in a
    loop with T. If a share a of what it adds is taken from the PID's integral, as `Hierarchy` does, T is replaced by
    T_a = a + (1 − a) T. The built-in learners also use the regressor of τ ago (`mrctl.control.matching.recall`).

    Attributes:
        positive_to: Frequency in rad/s up to which Re T(jω) > 0; infinite if Re T is positive everywhere.
        lowest: Least Re T.
        built_in_to: The same frequency for Re [T_a e^(jωτ)], the condition of the built-in learners.
        step: Largest μ at which the loop is stable without this hand-over.
        step_handed_over: Largest μ at which the loop is stable with the hand-over.
    """

    positive_to: float
    lowest: float
    built_in_to: float
    step: float
    step_handed_over: float


def safety(frequency: Array, response: Response, period: float, delay: float = 0.0) -> Safety:
    """Computes the frequencies and steps at which learning is safe, from T on a fine grid.

    Args:
        frequency: ω in rad/s, `(F,)`.
        response: T, `(F,)`.
        period: Control period h in s.
        delay: Delay d h of the loop in s that the learner knows; τ = (d + 2) h.
    """
    handed_over = HAND_OVER_SHARE + (1 - HAND_OVER_SHARE) * response
    early = np.exp(1j * frequency * (delay + HOLD_PERIODS * period))
    return Safety(
        positive_to=_positive_to(frequency, response),
        lowest=float(response.real.min()),
        built_in_to=_positive_to(frequency, handed_over * early),
        step=_largest_step(frequency, response, period),
        step_handed_over=_largest_step(frequency, handed_over, period),
    )


def _positive_to(frequency: Array, response: Response) -> float:
    """Returns the lowest frequency at which the real part is not positive, or infinity."""
    negative = np.flatnonzero(response.real <= 0)
    return float(frequency[negative[0]]) if negative.size else float("inf")


def _largest_step(frequency: Array, response: Response, period: float) -> float:
    """Returns the largest stable step, which is the gain margin of T/(z − 1)."""
    loop = response / (np.exp(1j * frequency * period) - 1)
    crossing = (loop.imag[:-1] * loop.imag[1:] < 0) & (loop.real[:-1] < 0)
    return float((1 / np.abs(loop[:-1][crossing])).min(initial=np.inf))
