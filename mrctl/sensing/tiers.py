"""Sensing tiers: values of the robot's sensors, motor driver, battery, steering servo and delay, `ideal` to `field`."""

from __future__ import annotations

from math import ceil
from typing import Annotated, Literal

from pydantic import Field

from mrctl.record import Record, is_whole
from mrctl.sensing.ekf import MAX_STORED
from mrctl.sensing.lidar import MIN_RATE, Lidar
from mrctl.theory.drive import (
    NO_LIMIT,
    Backlash,
    BatteryResistance,
    CurrentLimit,
    DeadZone,
    Driver,
    Offset,
    PwmSteps,
    SteeringServo,
)
from mrctl.theory.perturbation import MAX_DELAY

Tier = Literal["ideal", "lab", "field"]
TIERS: tuple[Tier, ...] = ("ideal", "lab", "field")
EstimatorName = Literal["truth", "odometry", "ekf"]
Localisation = Literal["fixes", "scan", "particles"]
MAX_FIXES_IN_FLIGHT = MAX_STORED - 1
"""Largest number of fixes that have been taken and have not arrived."""

DEGREE = 3.141592653589793 / 180  # rad
TIER_VALUES: dict[str, tuple[float, float, float]] = {
    # Lab: 512 pulses on the motor's shaft, four edges each, behind a gear of 43 (Maxon RE25 with an encoder MR 512).
    # Field: Kobuki's 2578.33 ticks a wheel turn (Yujin Robot, Kobuki user guide).
    "encoder_counts": (0, 88_064, 2_578),
    "encoder_rate": (0, 0, 0),  # with the control loop
    "encoder_latency": (0, 0, 0),  # chosen, like the other zeros: read over a bus in less than a control period
    # Bosch BMI088: 0.014 °/s/√Hz, with the vibration of a robot 0.017 (chosen). ST L3GD20: 0.03 °/s/√Hz.
    "gyro_noise": (0, 3e-4, 5e-4),
    "gyro_bias": (0, 2e-3, 0.5 * DEGREE),  # chosen: after a calibration at rest; within a L3GD20's drift in minutes
    "gyro_walk": (0, 1.9393e-5, 1e-4),  # lab: ADIS16448 of the EuRoC data sets (Burri et al. 2016); field: chosen
    "gyro_rate": (0, 0, 0),
    "gyro_latency": (0, 0, 0),
    "accelerometer_noise": (0, 1.6e-3, 2.2e-3),  # Bosch BMI088: 160 µg/√Hz. ST LSM303D: 220 µg/√Hz with vibration
    "accelerometer_bias": (0, 0.05, 0.2),  # chosen: 5 and 20 mg
    "accelerometer_walk": (0, 1e-3, 3e-3),  # lab: chosen; field: ADIS16448 of the EuRoC data sets
    "accelerometer_rate": (0, 0, 0),
    "accelerometer_latency": (0, 0, 0),
    # All chosen. Lab: a motion-capture system seen over a network. Field: scan matching on a map (AMCL, 10 Hz).
    "fix_rate": (0, 20, 10),
    "fix_position_noise": (0, 0.003, 0.02),
    "fix_heading_noise": (0, 0.003, 0.01),
    "fix_latency": (0, 0.01, 0.05),
    "fix_lost": (0, 0, 0.05),
    "fix_outliers": (0, 0, 0),
    "delay": (0, 0.01, 0.02),  # chosen: one and two control periods for bus, computation and PWM
    "dead_zone": (0, 0.2, 0.5),  # chosen, as all that follow
    "pwm_steps": (0, 1024, 256),
    "current_limit": (NO_LIMIT, 10, 6),
    "battery_resistance": (0, 0.05, 0.15),
    "steering_offset": (0, 0.2 * DEGREE, 1 * DEGREE),
    "steering_backlash": (0, 0, 1 * DEGREE),
}
"""Values of the three tiers in the units of the fields of `Sensing`; a rate of 0 is that of the control loop."""

START = {"start_position_noise": "fix_position_noise", "start_heading_noise": "fix_heading_noise"}
"""Fields whose default is the value of another field."""

AWAITED: dict[str, tuple[str, ...]] = {
    "truth": (),
    "odometry": ("encoder", "gyro"),
    "ekf": ("encoder", "gyro", "accelerometer"),
    "user": ("encoder", "gyro", "accelerometer"),
}
"""Sensors for whose samples each estimator waits; `user` stands for a user's, which may use all of them."""

LOCALISED: dict[str, dict[str, float]] = {
    "scan": {"fix_position_noise": 0.01, "fix_heading_noise": 0.005, "fix_lost": 0, "fix_outliers": 0},
    "particles": {"fix_position_noise": 0.02, "fix_heading_noise": 0.01, "fix_lost": 0, "fix_outliers": 0},
}
"""Values that replace the tier's where fixes come from a lidar: about twice the errors that the tests find."""

Rate = Annotated[float, Field(ge=0, le=10_000)]
Latency = Annotated[float, Field(ge=0, le=MAX_DELAY)]


class Sensing(Record):
    """Sensors, estimator, motor driver, battery, steering servo and delay: a tier, and values that replace its own.

    Where a scenario has a string in its place, that is the `tier`.
    """

    named_by = "tier"

    tier: Tier = "lab"
    """Quality of sensors, motor driver, battery and steering: exact (`ideal`), good (`lab`) or cheap (`field`)."""
    estimator: EstimatorName | None = None
    """Source of posture and twist: the `truth`, `odometry` from encoders and gyro, or an extended Kalman filter, `ekf`;
    by default the truth in the ideal tier and the filter in the others."""
    localisation: Localisation = "fixes"
    """Source of posture fixes: the `fixes` below, or a lidar and the map of the scenario, by matching
    each `scan` with the map or by a filter of `particles`. Fixes are always recorded, but of the estimators only `ekf`,
    or one of your own, uses them."""
    lidar: Lidar = Lidar()
    """Lidar, for localisation by `scan` or `particles`, for motion controllers that avoid obstacles, and for agents."""
    encoder_counts: Annotated[int, Field(ge=0, le=10**9)] | None = None
    """Counts of a wheel's encoder in one turn; 0 reads exact angles and rates."""
    encoder_rate: Rate | None = None
    """Rate of the encoders in Hz, a whole fraction of the control rate; 0 is the control rate."""
    encoder_latency: Latency | None = None
    """Age in s of the encoders' samples when they arrive, a multiple of the control period."""
    gyro_noise: Annotated[float, Field(ge=0, le=1)] | None = None
    """Noise density of the gyro in rad/s/√Hz."""
    gyro_bias: Annotated[float, Field(ge=0, le=1)] | None = None
    """Standard deviation of the gyro's bias at the start in rad/s."""
    gyro_walk: Annotated[float, Field(ge=0, le=1)] | None = None
    """Random walk of the gyro's bias in rad/s/√s."""
    gyro_rate: Rate | None = None
    """Rate of the gyro in Hz, a whole fraction of the control rate; 0 is the control rate."""
    gyro_latency: Latency | None = None
    """Age in s of the gyro's samples when they arrive, a multiple of the control period."""
    accelerometer_noise: Annotated[float, Field(ge=0, le=10)] | None = None
    """Noise density of the accelerometer in m/s²/√Hz."""
    accelerometer_bias: Annotated[float, Field(ge=0, le=10)] | None = None
    """Standard deviation of the accelerometer's bias at the start in m/s²."""
    accelerometer_walk: Annotated[float, Field(ge=0, le=10)] | None = None
    """Random walk of the accelerometer's bias in m/s²/√s."""
    accelerometer_rate: Rate | None = None
    """Rate of the accelerometer in Hz, a whole fraction of the control rate; 0 is the control rate."""
    accelerometer_latency: Latency | None = None
    """Age in s of the accelerometer's samples when they arrive, a multiple of the control period."""
    fix_rate: Rate | None = None
    """Rate of the posture fixes in Hz, a whole fraction of the control rate; 0 is the control rate."""
    fix_position_noise: Annotated[float, Field(ge=0, le=10)] | None = None
    """Standard deviation of x and y of a fix in m; with a lidar, which makes its own fixes, what the filter assumes."""
    fix_heading_noise: Annotated[float, Field(ge=0, le=3)] | None = None
    """Standard deviation of the heading of a fix in rad; with a lidar, what the filter assumes."""
    fix_latency: Latency | None = None
    """Age in s of a fix when it arrives, a multiple of the control period."""
    fix_lost: Annotated[float, Field(ge=0, le=1)] | None = None
    """Share of the fixes that never arrive."""
    fix_outliers: Annotated[float, Field(ge=0, le=1)] | None = None
    """Share of the fixes that are wrong by up to 1 m in x and y; not with a lidar."""
    start_position_noise: Annotated[float, Field(ge=0, le=10)] | None = None
    """Standard deviation of x and y of the first estimate of the posture in m; by default that of a fix. The
    estimator `truth` has none."""
    start_heading_noise: Annotated[float, Field(ge=0, le=3)] | None = None
    """Standard deviation of the heading of the first estimate in rad; by default that of a fix. The estimator
    `truth` has none."""
    start_unknown: bool = False
    """Whether the robot starts without an estimate of its posture, and looks for its place on the whole map; only with
    localisation by `scan` or `particles`."""
    delay: Latency | None = None
    """Delay from the measurement to the voltage in s, a multiple of the control period; the controller knows it."""
    dead_zone: DeadZone | None = None
    """Dead zone of the motor driver in V; a smaller commanded voltage has no effect."""
    pwm_steps: PwmSteps | None = None
    """Number of steps of the pulse width from zero to the full supply; 0 for a continuous pulse width."""
    current_limit: CurrentLimit | None = None
    """Current in A at which the driver chops the voltage of a motor; 1000 A stands for no limit."""
    battery_resistance: BatteryResistance | None = None
    """Resistance of battery and cables in Ω, through which the current of both motors lowers the supply voltage."""
    steering_offset: Offset | None = None
    """Constant error of the fork's angle in rad, positive to the left."""
    steering_backlash: Backlash | None = None
    """Backlash between the steering servo and the fork in rad, the full width of the play."""

    def __getitem__(self, name: str) -> float:
        """Returns the value of a field or, if it is None, that of the lidar or the tier, in the unit of the field."""
        own = getattr(self, name)
        if name in START and own is None:
            return self[START[name]]
        if self.localisation != "fixes" and own is None:
            if name == "fix_rate":
                return self.lidar.rate
            own = LOCALISED[self.localisation].get(name)
        return TIER_VALUES[name][TIERS.index(self.tier)] if own is None else own

    @property
    def source(self) -> EstimatorName:
        """The estimator: `estimator`, or by default the tier's."""
        return self.estimator or ("truth" if self.tier == "ideal" else "ekf")

    @property
    def driver(self) -> Driver:
        """Motor driver and battery."""
        names = "dead_zone", "battery_resistance", "current_limit"
        return Driver(pwm_steps=int(self["pwm_steps"]), **{name: self[name] for name in names})

    @property
    def servo(self) -> SteeringServo:
        """Servo of the steering."""
        return SteeringServo(offset=self["steering_offset"], backlash=self["steering_backlash"])

    def periods(self, name: str, control_period: float) -> int:
        """Returns a latency, a delay, or the period of a rate, in control periods.

        A value of the tier is rounded, and to at least one period if it is not zero.

        Args:
            name: Name of a field, such as `fix_rate` or `delay`.
            control_period: Control period in s.

        Raises:
            ValueError: A value that replaces the tier's is no whole number of control periods, or a rate is below
                `MIN_RATE`; the message names it.
        """
        value, rate = self[name], name.endswith("_rate")
        if rate and 0 < value < MIN_RATE:
            raise ValueError(f"sensing.{name}: {value:g} Hz is neither 0 nor at least {MIN_RATE:g} Hz")
        time = (1 / value if value else control_period) if rate else value
        count = round(time / control_period)
        if getattr(self, name) is None:
            return max(count, 1 if time else 0)
        if not is_whole(time / control_period):
            wrong = f"{value:g} s is not a whole multiple of control_period ({control_period:g} s)"
            if rate:
                wrong = f"{value:g} Hz is no whole fraction of the control rate ({1 / control_period:g} Hz)"
            raise ValueError(f"sensing.{name}: {wrong}")
        return count

    def latency(self, estimator: str, control_period: float) -> int:
        """Returns the latency of the slowest sensor for which an estimator waits, in control periods.

        Args:
            estimator: A key of `AWAITED`.
            control_period: Control period in s.
        """
        return max((self.periods(f"{name}_latency", control_period) for name in AWAITED[estimator]), default=0)

    def loop_delay(self, control_period: float, estimator: str | None = None) -> int:
        """Returns the delay of the loop for which controllers are designed, in control periods.

        It is `delay` and the age of the samples from which the estimate is made: their latency and `hold`.

        Args:
            control_period: Control period in s.
            estimator: A key of `AWAITED`; by default `source`, which a user's estimator replaces.
        """
        estimator = estimator or self.source
        age = self.latency(estimator, control_period) + self.hold(estimator, control_period)
        return self.periods("delay", control_period) + age

    def hold(self, estimator: str, control_period: float) -> int:
        """Returns how old the last samples of slow sensors are on average, in control periods, rounded up.

        A sample that comes every n periods is held for (n − 1)/2 of them on average, and the rate of an encoder that
        counts is a mean over n periods. `ekf` knows V if one of encoders and accelerometer is fast, and it extrapolates
        θ̇ over a slow gyro's samples by the command.

        Args:
            estimator: A key of `AWAITED`.
            control_period: Control period in s.
        """
        if estimator == "truth":
            return 0
        held = {name: (self.periods(f"{name}_rate", control_period) - 1) / 2 for name in AWAITED[estimator]}
        held["encoder"] *= 2 if self["encoder_counts"] else 1
        if estimator == "ekf":
            return ceil(min(held["encoder"], held["accelerometer"]))
        return ceil(max(held.values()))

    def check(self, control_period: float, duration: float) -> None:
        """Refuses rates and latencies that do not fit a run.

        Args:
            control_period: Control period in s.
            duration: Duration of the run in s.

        Raises:
            ValueError: A time is no whole number of control periods, more than four fixes are on their way at the same
                time, fixes are older than the run, `fix_rate` or `fix_outliers` is set though fixes come from a lidar,
                these come before the odometry that they need, or the start is unknown and nothing looks for it.
        """
        if self.start_unknown and (self.localisation == "fixes" or self.source != "ekf"):
            raise ValueError("sensing.start_unknown: needs localisation by scan or particles, and the estimator ekf")
        if self.localisation != "fixes":
            if self.fix_rate is not None:
                raise ValueError("sensing.fix_rate: with a lidar the rate of fixes is that of its scans, lidar.rate")
            if self.fix_outliers:
                raise ValueError("sensing.fix_outliers: has no effect with a lidar, which makes its own fixes")
            self.lidar.every(control_period)
        for name in TIER_VALUES:
            if name.endswith(("_rate", "_latency")) or name == "delay":
                self.periods(name, control_period)
        latency = self.periods("fix_latency", control_period)
        for sensor in AWAITED["odometry"]:  # a fix from a scan also needs the way since the last one
            name = f"{sensor}_latency"
            if self.localisation != "fixes" and latency < self.periods(name, control_period):
                raise ValueError(f"sensing.fix_latency: with a lidar it must be at least {name}, {self[name]:g} s")
        if latency > MAX_FIXES_IN_FLIGHT * self.periods("fix_rate", control_period):
            raise ValueError(
                f"sensing.fix_latency: more than {MAX_FIXES_IN_FLIGHT} fixes would be on their way at the same time"
            )
        if latency * control_period >= duration:
            raise ValueError(f"sensing.fix_latency: {self['fix_latency']:g} s, but the run takes {duration:g} s")


LAB = Sensing(tier="lab")
"""The default tier."""
