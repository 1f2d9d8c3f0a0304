"""Feedback-error learning with any stateless torch module, copied for each robot: the general form of `fel`.

It is `fel` without a model, which has no links from the heading.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.func import functional_call, stack_module_state, vjp, vmap

from mrctl.control.features import CHANNELS, FEATURES, feature_matrix, feature_scale
from mrctl.control.fel import BIAS_GAIN, HIDDEN_GAIN, REGULARISATION, Fel, fresh
from mrctl.control.matching import histories
from mrctl.kernel import Array
from mrctl.theory.robot import Robot


class Network(nn.Module):
    """The network of `fel` in torch, with the same weights: it maps 8 scaled features to 2 unscaled channels."""

    def __init__(self, hidden: int = 24) -> None:
        """Takes the number of hidden units; the layers behind them start at zero."""
        super().__init__()
        self.hidden = nn.Linear(FEATURES, hidden, dtype=torch.float64)
        self.output = nn.Linear(hidden, CHANNELS, dtype=torch.float64)
        self.direct = nn.Linear(FEATURES, CHANNELS, bias=False, dtype=torch.float64)
        for parameter in (self.output.weight, self.output.bias, self.direct.weight):
            nn.init.zeros_(parameter)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Maps features `(…, 8)` to channels `(…, 2)`."""
        hidden = HIDDEN_GAIN * torch.tanh(self.hidden(x))
        return hidden @ self.output.weight.T + BIAS_GAIN * self.output.bias + self.direct(x)


class ModuleLearning:
    """Feedback-error learning of B copies of a torch module, with the update and safeguards of `fel`.

    The output is scale · (f_W(x) − f_W₀(x)), so that learning begins as pure PID with any module. `simulate` takes it
    as `feedforward=lambda robot, size: ModuleLearning(module, robot, size)`, and tells it the delay of the loop. Under
    `rigid` steering it needs `rigid=True`, as a factory does not know the steering; without it the run is refused.

    Attributes:
        rigid: Whether the second channel is steering.
        state: Parameters W by name, each with a leading axis B.
        weight_norm: ‖W − W₀‖, `(B,)`.
    """

    def __init__(
        self, module: nn.Module, robot: Robot, size: int, settings: Fel | None = None, rigid: bool = False
    ) -> None:
        """Copies a module for B robots.

        Args:
            module: Maps scaled features `(8,)` to channels `(2,)`; it must have no buffers (running statistics).
            robot: The nominal robot, which sets the scales of the features.
            size: Number of robots B.
            settings: Settings of `fel`; `hidden` and `weights` have no effect.
            rigid: Whether the second channel is steering.

        Raises:
            ValueError: The module has buffers, or does not map 8 inputs to 2 outputs.
        """
        if buffers := [name for name, _ in module.named_buffers()]:
            raise ValueError(f"module: {buffers[0]} is a buffer; running state cannot be copied per robot")
        settings = settings or Fel()
        self._module = copy.deepcopy(module).double().eval()
        try:
            shape = tuple(self._module(torch.zeros(FEATURES, dtype=torch.float64)).shape)
        except RuntimeError as error:
            raise ValueError(f"module: does not map 8 features to 2 channels: {error}") from None
        if shape != (CHANNELS,):
            raise ValueError(f"module: maps 8 features to shape {shape}, not to 2 channels")
        self.rigid = rigid
        self._half_track = robot.half_track
        self._scale = feature_scale(robot)
        start = fresh([settings], rigid)[0]
        self._output_scale, self._dead_zone, self._share = (
            torch.tensor(start[name].copy()) for name in ("scale", "dead_zone", "share")
        )
        self._step, self._leak, self._bound = float(start["step"]), float(start["leak"]), float(start["bound"])
        self._features = np.zeros((size, FEATURES))
        self._queue, self._tick = histories(size, 0, FEATURES), np.zeros(size, int)
        stacked, _ = stack_module_state([self._module] * size)
        self.initial = {name: value.detach().clone() for name, value in stacked.items()}
        self.state = {name: value.clone() for name, value in self.initial.items()}
        self.weight_norm = np.zeros(size)

    def reset(self, period: float, delay: float) -> None:
        """Takes the control period and the delay of the loop in s; see `Feedforward.reset`."""
        self._queue = histories(len(self._tick), round(delay / period), FEATURES)

    def restore(self, rows: NDArray[np.intp]) -> None:
        """Resets robots to the parameters of the module."""
        for name, value in self.state.items():
            value[rows] = self.initial[name][rows]
        self._tick[rows], self.weight_norm[rows] = 0, 0.0

    def adapted(self) -> dict[str, torch.Tensor]:
        """Returns the parameters of each robot, and those of its module at the start, which its output refers to."""
        return self.state | {f"initial.{name}": value for name, value in self.initial.items()}

    def adopt(self, row: int, learned: Mapping[str, Array]) -> None:
        """Lets one robot start from a row of `adapted`."""
        for name, value in self.state.items():
            value[row] = torch.from_numpy(learned[name])
            self.initial[name][row] = torch.from_numpy(learned[f"initial.{name}"])
        moved = {name: (value - self.initial[name])[[row]] for name, value in self.state.items()}
        self.weight_norm[row] = float(_square(moved).sqrt())

    def _forward(self, parameters: dict[str, torch.Tensor], features: Array) -> torch.Tensor:
        x = torch.from_numpy(features)
        return vmap(lambda p, row: functional_call(self._module, p, (row,)))(parameters, x)

    def output(self, command: Array, derivative: Array) -> Array:
        """Returns the outputs of the modules at the commanded motion."""
        self._features = x = feature_matrix(command, derivative, self._half_track, self._scale)
        with torch.no_grad():
            return (self._output_scale * (self._forward(self.state, x) - self._forward(self.initial, x))).numpy()

    def learn(self, feedback: Array, frozen: Array, twist: Array, voltage: Array) -> Array:
        """Does the step of `fel.update` for all robots, with Jᵀe by automatic differentiation."""
        every, oldest = np.arange(len(self._tick)), self._tick % self._queue.shape[1]
        answered = self._tick >= self._queue.shape[1]
        past = self._queue[every, oldest]
        self._queue[every, oldest] = self._features
        self._tick += 1
        fb = torch.from_numpy(np.array(feedback))
        error = torch.where(fb.abs() > self._dead_zone, self._share * fb / self._output_scale, 0.0)
        power = (error**2).sum(1)
        allowed = torch.from_numpy(answered & (np.asarray(frozen) == 0) & (self._step > 0))
        active = (power > 0) & allowed
        pull = vjp(lambda state: self._forward(state, past), self.state)[1]
        (gradient,) = pull(error)
        square = _square(gradient)
        rate = torch.where(active, self._step / (square / power.clamp_min(1e-300) + REGULARISATION), 0.0)
        leak = self._leak * active.double()  # `where` of two plain numbers would be single precision
        moved = {
            name: self.state[name] + _like(rate, g) * g - _like(leak, g) * (self.state[name] - self.initial[name])
            for name, g in gradient.items()
        }
        distance = _square({name: moved[name] - self.initial[name] for name in moved}).sqrt()
        shrink = torch.where(active & (distance > self._bound), self._bound / distance.clamp_min(1e-300), 1.0)
        with torch.no_grad():
            before = self._forward(self.state, self._features)
        for name, value in moved.items():
            self.state[name] = self.initial[name] + (value - self.initial[name]) * _like(shrink, value)
        norm = torch.where(active, distance.clamp_max(self._bound), torch.from_numpy(self.weight_norm))
        self.weight_norm = norm.numpy()
        with torch.no_grad():
            added = self._output_scale * (self._forward(self.state, self._features) - before)
        return torch.where((norm >= self._bound)[:, None], 0.0, added).numpy()


def _square(layers: dict[str, torch.Tensor]) -> torch.Tensor:
    """Squared Euclidean norm of all parameters of each robot, `(B,)`."""
    return torch.stack([(layer**2).reshape(len(layer), -1).sum(1) for layer in layers.values()]).sum(0)


def _like(row: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Reshapes `(B,)` so that it broadcasts against `(B, …)`."""
    return row.reshape(-1, *[1] * (value.ndim - 1))
