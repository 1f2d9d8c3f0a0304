"""Motor driver, battery and steering servo: from commands to the voltages of the motors and the set-point of the fork.

The laws are those of one robot. The defaults of the records are ideal; a sensing tier sets other values.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from mrctl.kernel import Array, Row, kernel
from mrctl.record import Record

NO_LIMIT = 1000.0
"""Current limit in A that stands for none."""

DeadZone = Annotated[float, Field(ge=0, le=10)]
PwmSteps = Annotated[int, Field(ge=0, le=65536)]
CurrentLimit = Annotated[float, Field(ge=0.1, le=NO_LIMIT)]
BatteryResistance = Annotated[float, Field(ge=0, le=2)]
Offset = Annotated[float, Field(ge=-0.5, le=0.5)]
Backlash = Annotated[float, Field(ge=0, le=0.5)]

DRIVER = np.dtype(
    [
        # Settings, as in `Driver`
        ("dead_zone", "f8"),  # V
        ("pwm_steps", "f8"),  # number of steps of the pulse width from zero to `supply`; 0 for a continuous one, 1
        ("current_limit", "f8", 2),  # of the motors left and right, A; infinite for none
        ("battery_resistance", "f8"),  # Ω
        ("supply", "f8"),  # nominal supply voltage U_n, the command for the full pulse width, V
        ("gain", "f8"),  # open-circuit voltage of the battery over `supply`
        # Result
        ("scale", "f8"),  # voltage of the battery over `supply`
    ],
    align=True,
)

SERVO = np.dtype(
    [
        ("offset", "f8"),  # rad
        ("backlash", "f8"),  # rad
        ("play", "f8"),  # angle behind the backlash, rad
    ],
    align=True,
)


class Driver(Record):
    """Motor driver and battery of a robot; the default is ideal."""

    dead_zone: DeadZone = 0.0
    """Dead zone in V; a smaller commanded voltage has no effect."""
    pwm_steps: PwmSteps = 0
    """Number of steps of the pulse width from zero to the full supply; 0 for a continuous pulse width."""
    current_limit: CurrentLimit = NO_LIMIT
    """Current in A at which the driver chops the voltage of a motor; 1000 A, the default, stands for no limit."""
    battery_resistance: BatteryResistance = 0.0
    """Resistance of battery and cables in Ω, through which the current of both motors lowers the supply voltage."""


class SteeringServo(Record):
    """Imperfections of the servo that steers the fork; the default has none."""

    offset: Offset = 0.0
    """Constant error of the fork's angle in rad, positive to the left."""
    backlash: Backlash = 0.0
    """Backlash between the servo and the fork in rad, the full width of the play."""


@kernel
def drive(command: Array, emf: Array, resistance: Array, d: Row, voltage: Array) -> None:
    """Voltages that a driver sends to its motors, before its current limit acts.

        u → 0 if |u| < dead zone → δ = round(n u/U_n)/n → U = δ U_bat

    The order is that of the parts: the dead zone of the driver, the n steps of the pulse width, and the bridge, which
    applies the sagging voltage of the battery for the share δ of the time. The current limit comes last, because it
    depends on the current of the motor: see `chop`.

    Args:
        command: Commanded voltages left and right in V, `(2,)`.
        emf: Back-EMF of the motors in V, `(2,)`.
        resistance: Resistances of the motors in Ω, `(2,)`.
        d: In and out: a record of `DRIVER`, whose `scale` is a result.
        voltage: Out: voltages left and right in V, `(2,)`.
    """
    for k in range(2):
        voltage[k] = 0.0 if abs(command[k]) < d.dead_zone else command[k]
        if d.pwm_steps > 0:
            voltage[k] = np.rint(voltage[k] / d.supply * d.pwm_steps) / d.pwm_steps * d.supply
    d.scale = d.gain
    if d.battery_resistance > 0:
        d.scale = battery_voltage(voltage, emf, resistance, d) / d.supply
    for k in range(2):
        voltage[k] *= d.scale


@kernel
def battery_voltage(command: Array, emf: Array, resistance: Array, d: Row) -> float:
    """Voltage U of a battery under the current of two motors, which itself depends on U.

        U = U_0 − R_b Σ δ_i i_i,    i_i = (δ_i U − e_i)/R_i

    A motor at its current limit I takes the power p_i = (e_i ± R_i I)(±I), and the current p_i/U from the battery. With
    p the sum over these motors, and g and h sums over the others, the law is a quadratic equation. Its larger root is
    the stable one, and exists because the limits only lower the power. U is not negative: where the motors would
    reverse it, the diodes of the bridge conduct, and U is 0.

        (1 + g) U² − (U_0 + h) U + R_b p = 0,    g = R_b Σ δ_i²/R_i,    h = R_b Σ δ_i e_i/R_i

    U without limits decides which motors are at their limit. Currents are those at the beginning of the control period
    for which U is held; within it the back-EMF of a robot on the ground changes by a few percent of the voltage.

    Args:
        command: Voltages left and right in V for the nominal supply: δ U_n, `(2,)`.
        emf: Back-EMF of the motors in V, `(2,)`.
        resistance: Resistances of the motors in Ω, `(2,)`.
        d: A record of `DRIVER`.
    """
    source = d.supply * d.gain
    voltage = source
    for limited in (False, True):
        square, linear, power = 1.0, source, 0.0
        for k in range(2):
            duty, limit = command[k] / d.supply, d.current_limit[k]
            current = (duty * voltage - emf[k]) / resistance[k]
            if limited and abs(current) > limit:
                current = limit if current > 0 else -limit
                power += d.battery_resistance * (emf[k] + resistance[k] * current) * current
            else:
                square += d.battery_resistance * duty * duty / resistance[k]
                linear += d.battery_resistance * duty * emf[k] / resistance[k]
        voltage = (linear + np.sqrt(max(0.0, linear * linear - 4 * square * power))) / (2 * square)
    return voltage


@kernel
def chop(voltage: float, emf: float, resistance: float, limit: float) -> float:
    """Terminal voltage of a motor whose current the driver limits by chopping: U within [e − R I, e + R I].

    MuJoCo applies the same limit to the torque k_M i in each of its steps, so that |i| ≤ I within a control period too;
    U is the mean voltage for that torque. The current of a winding with inductance follows within L/R, which is short
    compared with a step.

    Args:
        voltage: Voltage without the limit in V.
        emf: Back-EMF e of the motor in V.
        resistance: Resistance R of the motor in Ω.
        limit: Largest current I in A, infinite for none.
    """
    return max(emf - resistance * limit, min(emf + resistance * limit, voltage))


@kernel
def turn(angle: float, rate: float, s: Row) -> tuple[float, float]:
    """Set-point of the fork behind a servo with backlash and offset, by the play operator.

        w ← min(max(w, φ − b/2), φ + b/2),    φ_fork = w + offset

    Within the play the fork stands still, so its rate is zero there; at the ends it is the rate of the set-point.
    (Visintin, Differential Models of Hysteresis, 1994, ch. III.)

    Args:
        angle: Set-point φ in rad.
        rate: Rate of the set-point in rad/s.
        s: In and out: a record of `SERVO`.

    Returns:
        Angle in rad and rate in rad/s of the fork's set-point.
    """
    half = s.backlash / 2
    if abs(angle - s.play) < half:
        return s.play + s.offset, 0.0
    s.play = angle - half if angle > s.play else angle + half
    return s.play + s.offset, rate
