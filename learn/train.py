"""Training of any registered model: windows in a global shuffle, Adam or Muon, weight averaging, validation by rollout, resuming.

A run folder holds ``checkpoint.pt`` (all that resuming needs), ``best.pt`` (the averaged weights with the smallest rollout error: all
that inference needs), ``log.csv``, ``validation.csv`` and, at the end, ``done.json``. With a budget in steps, on a CPU with one thread, a
run that is killed at any instant and started again ends bitwise where the unbroken run ends.

Decision: a budget in minutes counts everything from the reading of the data on, validation included, because that is what a user waits
for; only the last validation may exceed it. Progress is then elapsed / budget, so such a run is resumed, but not bitwise.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn
from torch.optim.adam import adam
from tqdm import tqdm

from learn.checkpoint import STATE_KEYS, build_model, load_state, load_weights, save_model, save_state, validate
from learn.dataset import Dataset, DataSettings, Sampler, Windows
from learn.metrics import frame_mse, spacing_ratio
from learn.parallel import Processes
from learn.replay import TrainingReplay
from learn.variants import with_variant
from sim import __version__, periodic
from sim.errors import InputError, RunError
from sim.scene import read_yaml
from sim.simulator import rollout, start_from
from sim.trajectory import KINEMATIC_TYPE, Trajectory, write_json, write_text

LOG_COLUMNS = ("step", "seconds", "loss", "learning_rate", "gradient_norm", "window")
VALIDATION_COLUMNS = ("step", "seconds", "rollout_mse", "spacing_ratio", "finished", "best")


class TrainSettings(BaseModel):
    """How a model is trained. Exactly one of ``steps`` and ``minutes`` is the budget."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    steps: int | None = Field(None, ge=1)  # budget in optimiser steps
    minutes: float | None = Field(None, gt=0)  # budget in minutes of wall time, validation included
    batch: int = Field(2, ge=1)  # windows a step, of all processes together
    edges: int | None = Field(None, ge=1)  # instead of ``batch``: as many windows as have so many edges, by the data's mean neighbours
    learning_rate: float = Field(1e-4, gt=0)
    final_learning_rate: float = Field(1e-6, ge=0)  # floor of the schedule
    schedule: Literal["cosine", "exponential"] = "cosine"  # over the budget; or the paper's decay over steps
    decay_steps: int = Field(5_000_000, ge=1)  # exponential only: steps in which the learning rate falls tenfold
    warmup_steps: int = Field(100, ge=0)  # steps of linear warm-up
    gradient_clip: float | None = Field(1.0, gt=0)  # largest norm of the whole gradient; null: none
    optimizer: Literal["adam", "muon"] = "adam"  # the paper's; or Muon for the weight matrices, which the grid emulator learns faster with
    weight_decay: float = Field(0.0, ge=0)  # decoupled (AdamW); 0 is Adam
    average_decay: float = Field(0.999, ge=0, lt=1)  # of the exponential average of the weights; 0: none
    validations: int = Field(10, ge=1)  # evenly over the budget, the last at its end
    validate_every: int | None = Field(None, ge=1)  # steps; instead of ``validations``
    validation_trajectories: int = Field(5, ge=1)  # the first ones of the validation split
    validation_frames: int | None = Field(None, ge=1)  # length of a validation rollout; null: to the end of the trajectory
    log_every: int = Field(50, ge=1)  # steps a row of log.csv
    checkpoint_seconds: float = Field(60.0, gt=0)  # at most this much work is lost by a kill ...
    checkpoint_every: int | None = Field(None, ge=1)  # ... and a checkpoint also every so many steps
    seed: int = Field(0, ge=0, lt=2**63)
    threads: int = Field(1, ge=1, le=1024)  # CPU threads; resuming is bitwise with one
    device: Literal["auto", "cpu", "cuda"] = "auto"  # auto: cuda where there is one
    tensorboard: bool = False  # log.csv and validation.csv into the run folder's tensorboard/ too; needs the package tensorboard

    @model_validator(mode="after")
    def _one_budget(self) -> TrainSettings:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("give exactly one of steps and minutes")
        if self.final_learning_rate > self.learning_rate:
            raise ValueError("final_learning_rate must not exceed learning_rate")
        return self

    def rate(self, step: int, progress: float) -> float:
        """Learning rate of step ``step`` (from 0) at ``progress`` (0..1) of the budget, r0 = ``learning_rate``, r1 = ``final_learning_rate``.

        cosine: r1 + (r0 - r1) (1 + cos(pi progress)) / 2; exponential (Sanchez-Gonzalez et al. 2020): r1 + (r0 - r1) 0.1^(step / decay_steps);
        both times min(1, (step + 1) / warmup_steps).
        """
        if self.schedule == "cosine":
            share = (1 + math.cos(math.pi * min(progress, 1.0))) / 2
        else:
            share = 0.1 ** (step / self.decay_steps)
        warm = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        return warm * (self.final_learning_rate + (self.learning_rate - self.final_learning_rate) * share)


class Config(BaseModel):
    """A file of ``configs/models/``: which model, its settings, how it is trained, how windows are drawn."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    model: str
    settings: dict = {}
    training: TrainSettings
    data: DataSettings = DataSettings()


def load_config(path: str | Path, overrides: dict | None = None, variant: str | None = None) -> Config:
    """Read and check a configuration file; ``overrides`` replace keys of ``training`` (a budget replaces the other kind of budget), a ``variant`` of
    those that the file names under ``variants`` keys of settings, training and data.

    Every fault is an ``InputError``. The model's own settings are checked when the model is built.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(path, "file", type(content).__name__, "must be a mapping with the keys model, settings, training, data")
    content = with_variant(content, variant, path)
    if overrides and isinstance(content.get("training"), dict):
        training = dict(content["training"])
        if {"steps", "minutes"} & set(overrides):
            training.pop("steps", None)
            training.pop("minutes", None)
        content = {**content, "training": {**training, **overrides}}
    return validate(Config, content, path, "")


def resolve_device(name: str, where: object) -> torch.device:
    """The torch device of ``auto``, ``cpu`` or ``cuda``; ``InputError`` where there is no CUDA device."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(where, "device", name, "this machine has no CUDA device that torch can use; choose cpu or auto")
    return torch.device(name)


class Adam:
    """Adam (Kingma and Ba 2015) with decoupled weight decay (Loshchilov and Hutter 2019), one fused call a step.

    m <- b1 m + (1 - b1) g; v <- b2 v + (1 - b2) g^2; w <- w - rate (m' / (sqrt(v') + eps) + weight_decay w), m' and v' without their start-up
    bias; b1 = 0.9, b2 = 0.999, eps = 1e-8. ``torch.optim.AdamW`` calls the same function, but its constructor imports torch's compiler (7 s).
    """

    def __init__(self, parameters: list[nn.Parameter], weight_decay: float):
        self.parameters, self.weight_decay = parameters, weight_decay
        self.mean, self.square = ([torch.zeros_like(parameter) for parameter in parameters] for _ in range(2))
        self.steps = [torch.zeros((), device=parameter.device) for parameter in parameters]

    @torch.no_grad()
    def step(self, rate: float | Tensor, found_inf: Tensor | None = None) -> None:
        """One step at learning rate ``rate``; parameters without a gradient stay, and all where ``found_inf`` [] is 1."""
        used = [k for k, parameter in enumerate(self.parameters) if parameter.grad is not None]
        lists = (self.parameters, [parameter.grad for parameter in self.parameters], self.mean, self.square)
        weights, gradients, mean, square = ([entries[k] for k in used] for entries in lists)
        adam(
            weights,
            gradients,
            mean,
            square,
            [],
            [self.steps[k] for k in used],
            fused=True,
            found_inf=found_inf,
            amsgrad=False,
            maximize=False,
            beta1=0.9,
            beta2=0.999,
            eps=1e-8,
            lr=rate,
            weight_decay=self.weight_decay,
            decoupled_weight_decay=True,
        )

    def state(self) -> dict[str, list[Tensor]]:
        """What ``restore`` needs."""
        return {"mean": self.mean, "square": self.square, "steps": self.steps}

    def restore(self, state: dict[str, list[Tensor]]) -> None:
        """Continue from ``state``; ``ValueError`` or ``RuntimeError`` if it is another model's."""
        for own, given in ((self.mean, state["mean"]), (self.square, state["square"]), (self.steps, state["steps"])):
            for value, entry in zip(own, given, strict=True):
                value.copy_(entry)


class Muon:
    """Muon (Jordan et al. 2024) for weight matrices, ``Adam`` for what is none.

    M <- b M + (1 - b) G; w <- w - rate (0.2 sqrt(max(rows, columns)) ortho((1 - b) G + b M) + weight_decay w), b = 0.95: Nesterov momentum, its
    singular values brought near 1 by five Newton-Schulz steps X <- a X + (b A + c A A) X with A = X X^T. The factor gives a step the
    root mean square of Adam's, so that one learning rate serves both (Liu et al. 2025, arXiv 2502.16982, eq. 4). A matrix is a
    parameter whose last two axes are both 16 long or longer, leading axes (stencils) taken as rows. ``torch.optim.Muon`` works in
    bfloat16, which most CPUs emulate, and on one matrix at a time; here those of one shape go together, in float32.
    """

    MOMENTUM, STEPS, COEFFICIENTS, SMALLEST_SIDE = 0.95, 5, (3.4445, -4.7750, 2.0315), 16

    def __init__(self, parameters: list[nn.Parameter], weight_decay: float):
        self.weight_decay = weight_decay
        self.groups: dict[tuple[int, int], list[nn.Parameter]] = {}
        others = []
        for parameter in parameters:
            if parameter.ndim >= 2 and min(parameter.shape[-2:]) >= self.SMALLEST_SIDE:
                self.groups.setdefault((parameter.shape[:-1].numel(), parameter.shape[-1]), []).append(parameter)
            else:
                others.append(parameter)
        self.momentum = [group[0].new_zeros(len(group), *shape, requires_grad=False) for shape, group in self.groups.items()]
        self.adam = Adam(others, weight_decay)

    @torch.no_grad()
    def step(self, rate: float | Tensor, found_inf: Tensor | None = None) -> None:
        """One step at learning rate ``rate``; parameters without a gradient stay, and all where ``found_inf`` [] is 1."""
        for momentum, (shape, group) in zip(self.momentum, self.groups.items(), strict=True):
            used = [k for k, parameter in enumerate(group) if parameter.grad is not None]
            if used:
                gradient = torch.stack([group[k].grad.reshape(shape) for k in used])
                rows = slice(None) if len(used) == len(group) else used  # a list of numbers has to be brought to a GPU
                before, decay = momentum[rows], rate * self.weight_decay
                moved = before.lerp(gradient, 1 - self.MOMENTUM)
                updates = self.orthogonal(gradient.lerp(moved, self.MOMENTUM)).mul_(0.2 * math.sqrt(max(shape)) * rate)
                if found_inf is not None:
                    good = found_inf == 0
                    moved, updates, decay = torch.where(good, moved, before), torch.where(good, updates, 0), torch.where(good, decay, 0)
                momentum[rows] = moved
                for k, update in zip(used, updates, strict=True):
                    group[k].mul_(1 - decay).sub_(update.view_as(group[k]))
        self.adam.step(rate, found_inf)

    def orthogonal(self, x: Tensor) -> Tensor:
        """[n, rows, columns] with the singular vectors of ``x`` and singular values near 1 (0.6 to 1.2; tiny ones stay smaller)."""
        a, b, c = self.COEFFICIENTS
        tall = x.shape[1] > x.shape[2]
        x = x.mT if tall else x
        x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=1e-20)
        for _ in range(self.STEPS):
            gram = x @ x.mT
            x = a * x + (b * gram + c * gram @ gram) @ x
        return (x.mT if tall else x).contiguous()

    def state(self) -> dict[str, list[Tensor]]:
        """What ``restore`` needs."""
        return {"momentum": self.momentum, **self.adam.state()}

    def restore(self, state: dict[str, list[Tensor]]) -> None:
        """Continue from ``state``; ``ValueError`` or ``RuntimeError`` if it is another model's."""
        for value, entry in zip(self.momentum, state["momentum"], strict=True):
            value.copy_(entry)
        self.adam.restore(state)


OPTIMIZERS: dict[str, type[Adam] | type[Muon]] = {"adam": Adam, "muon": Muon}


class _Interrupted(Exception):
    """A signal asked the run to stop."""


class _Table:
    """A CSV file that only grows, and can be cut back to a step."""

    def __init__(self, path: Path, columns: tuple[str, ...], step: int):
        """Open ``path``, keeping the rows of an earlier run up to ``step``."""
        rows = []
        if step > 0 and path.is_file():
            for row in csv.reader(io.StringIO(path.read_text())):
                if len(row) == len(columns) and row[0].isdigit() and int(row[0]) <= step:
                    rows.append(row)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([columns, *rows])
        write_text(path, text.getvalue())
        self._file = open(path, "a", newline="")  # noqa: SIM115 (open as long as the run)
        self._writer = csv.writer(self._file, lineterminator="\n")

    def add(self, *values: object) -> None:
        self._writer.writerow(values)
        self._file.flush()

    def sync(self) -> None:
        """Rows up to a checkpoint must reach the disk before it does."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


class Trainer:
    """One training run: construct (checks everything and writes nothing), then ``run()``.

    data: folder of the data set with the splits ``train`` and ``valid``; run: the run folder; where: names the configuration in errors. Of the
    processes of a ``torchrun`` (``learn.parallel``) the first writes, and says what is said.
    Raises ``InputError`` for faults of the input, among them a run folder that holds another run.
    """

    def __init__(self, config: Config, data: str | Path, run: str | Path, where: object = "config"):
        self.config, self.settings, self.folder, self.where = config, config.training, Path(run), where
        self.started = time.perf_counter()
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(self.folder, "--out", str(self.folder), "is not a folder; give another name")
        self.processes = Processes(resolve_device(self.settings.device, where), where)
        self.device = self.processes.device
        torch.set_num_threads(self.settings.threads)
        self.train_data, self.valid_data = Dataset(data, "train"), Dataset(data, "valid")
        self.spec = self.train_data.spec(config.data.stride)
        torch.manual_seed(self.settings.seed)
        self.model = build_model(config.model, config.settings, self.spec, where).to(self.device)
        self.parameters = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimizer: Adam | Muon = OPTIMIZERS[self.settings.optimizer](self.parameters, self.settings.weight_decay)
        self.average = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        batch = None if self.settings.edges else self.settings.batch
        self.sampler = Sampler(self.train_data, config.data, batch, self.settings.seed, self.settings.edges, self.processes)
        self.generator = torch.Generator().manual_seed(self.settings.seed)
        self.progress_state: dict[str, Any] = {
            "step": 0,
            "seconds": 0.0,
            "validated_step": 0,
            "validations": 0,
            "best_mse": None,
            "best_step": None,
            "loss_sum": 0.0,
            "norm_sum": 0.0,
            "logged": 0,
            "validation_seconds": 0.0,
        }
        self._check_lengths()
        self._resume()
        self._seconds_before = self.progress_state["seconds"]
        self._stop: str | None = None
        self._rolling = False
        alone = self.processes.size == 1 and self.settings.edges is None
        self.replayed = alone and getattr(self.model, "replayable", False)
        self._replay: TrainingReplay | None = None

    # -- set-up --------------------------------------------------------------------------------------------------------------

    def _check_lengths(self) -> None:
        """Windows and validation rollouts must fit in the trajectories, at the start of the training and at its end."""
        least = self.processes.size
        batch = least if self.settings.edges else self.settings.batch
        if batch < least:
            raise InputError(self.where, "training.batch", batch, f"must be at least 1 a process, of which there are {least}")
        if self.settings.tensorboard and find_spec("tensorboard") is None:
            raise InputError(self.where, "training.tensorboard", True, "the package tensorboard is missing; pip install it, or set false")
        for progress in (0.0, 1.0):
            found = self.train_data.windows(self.model.window(progress), self.config.data.stride, self.config.data.skip_rest)
            if len(found) < batch:
                raise InputError(self.where, "training.batch", batch, f"the training split has only {len(found)} windows")
        shortest = min(shape[0] for shape in self.valid_data.shapes[: self.settings.validation_trajectories])
        if shortest <= self.model.history:
            raise InputError(self.valid_data.path, "splits.valid", shortest, f"needs trajectories of more than {self.model.history} frames")
        self.trajectories = [self.valid_data.trajectory(number) for number in range(min(self.settings.validation_trajectories, len(self.valid_data)))]

    def _resume(self) -> None:
        path = self.folder / "checkpoint.pt"
        if not path.is_file():
            return
        state = load_state(path, "cpu")
        for name, own in (("config", self._config_dict()), ("spec", json.loads(json.dumps(self.spec.to_dict())))):
            if state[name] != own:
                key = _first_difference(state[name], own)
                remedy = f"the run in this folder was started with another {name} ({key}); give another --out, or delete the folder"
                raise InputError(path, f"{name}.{key}", _at(own, key), remedy)
        load_weights(self.model, state["average"], path)
        self.average = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        load_weights(self.model, state["model"], path)
        try:
            self.optimizer.restore(state["optimizer"])
            self.sampler.restore(state["sampler"])
            self.generator.set_state(state["generator"])
            torch.set_rng_state(state["torch_random"])
            if self.device.type == "cuda" and state["device_random"]:
                torch.cuda.set_rng_state(state["device_random"][0], self.device)
            self.progress_state = {name: state["progress"][name] for name in self.progress_state}
            if not all(value is None or isinstance(value, (int, float)) for value in self.progress_state.values()):
                raise ValueError("progress must hold numbers")
        except InputError:
            raise
        except (KeyError, ValueError, RuntimeError, TypeError, IndexError, AttributeError) as error:
            raise InputError(path, "file", str(error), "damaged training state; delete the run folder and train again") from None

    def _config_dict(self) -> dict:
        return json.loads(json.dumps(self.config.model_dump(mode="json")))

    # -- the loop ------------------------------------------------------------------------------------------------------------

    @property
    def step(self) -> int:
        """Optimiser steps done."""
        return self.progress_state["step"]

    def seconds(self) -> float:
        """Seconds since the run began, all its sessions together, without what a kill threw away."""
        return self._seconds_before + time.perf_counter() - self.started

    def progress(self) -> float:
        """Share of the budget that is spent, 0..1."""
        if self.settings.steps is not None:
            return min(self.step / self.settings.steps, 1.0)
        assert self.settings.minutes is not None  # the one or the other
        return min(self.seconds() / (60 * self.settings.minutes), 1.0)

    def run(self) -> dict:
        """Train to the end of the budget and return the content of ``done.json``.

        Raises ``RunError`` on a loss that is not finite, where the run folder cannot be written (a full disk), and after SIGTERM or
        SIGINT (a checkpoint is written first).
        """
        try:
            return self._run()
        except OSError as error:
            reason = error.strerror or error
            raise RunError(f"{self.folder}: cannot be written ({reason}); mend that and give the same command again to resume") from None
        finally:
            self.processes.close()

    def _run(self) -> dict:
        done = self.folder / "done.json"
        if done.is_file() and self.step > 0 and self._finished_before(done):
            return json.loads(done.read_text())
        if not self.processes.leads:
            return self._follow()
        self.folder.mkdir(parents=True, exist_ok=True)
        for abandoned in self.folder.glob(".*.pt.*.tmp.pt"):  # what a kill in the middle of writing left
            abandoned.unlink()
        self.log = _Table(self.folder / "log.csv", LOG_COLUMNS, self.step)
        self.validation = _Table(self.folder / "validation.csv", VALIDATION_COLUMNS, self.progress_state["validated_step"])
        self.board = None
        if self.settings.tensorboard:
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(str(self.folder / "tensorboard"), purge_step=self.step)
        self._saved_at, self._printed_at = time.perf_counter(), -math.inf
        self.model.train()
        try:
            with self._signals(), self._bar():
                self._loop()
        except _Interrupted:
            self._checkpoint()
            message = f"{self.folder}: stopped by {self._stop} at step {self.step}; give the same command again to resume"
            raise RunError(message) from None
        finally:
            self.log.close()
            self.validation.close()
            if self.board:
                self.board.close()
        content = {
            "steps": self.step,
            "seconds": self.seconds(),
            "validation_seconds": self.progress_state["validation_seconds"],
            "best_rollout_mse": self.progress_state["best_mse"],
            "best_step": self.progress_state["best_step"],
            "parameters": sum(parameter.numel() for parameter in self.parameters),
            "model": self.config.model,
            "device": str(self.device),
            "threads": self.settings.threads,
            "processes": self.processes.size,
            "config": self._config_dict(),
        }
        write_json(done, content)
        return content

    def _follow(self) -> dict:
        """What a process does that does not lead; returns nothing of interest."""
        self.model.train()
        with self._signals():
            while True:
                progress, stop = self.processes.agree(0.0, bool(self._stop))
                if progress >= 1:
                    return {}
                if stop:
                    raise RunError(f"{self.folder}: stopped at step {self.step}")
                self._train_step(progress)

    def _finished_before(self, done: Path) -> bool:
        try:
            return json.loads(done.read_text())["steps"] == self.step
        except (ValueError, KeyError, TypeError):
            return False

    def _loop(self) -> None:
        while True:
            progress = self.progress()
            if self._validation_due(progress):
                self._validate()
            progress, stop = self.processes.agree(progress, bool(self._stop))
            if progress >= 1:
                return
            if stop:
                self._stop = self._stop or "another process"
                raise _Interrupted
            self._train_step(progress)
            every = self.settings.checkpoint_every
            if time.perf_counter() - self._saved_at >= self.settings.checkpoint_seconds or (every and self.step % every == 0):
                self._checkpoint()

    def _train_step(self, progress: float) -> None:
        state, frames = self.progress_state, self.model.window(progress)
        windows = self.sampler.next(frames)
        rate = self.settings.rate(self.step, progress)
        state["logged"] += 1
        if self.replayed:
            if self._replay is None or self._replay.frames != frames:
                self._settle()
                self._replay = None  # before the next one takes as much memory
                largest = max(shape[1] for shape in self.train_data.shapes)
                clip = self.settings.gradient_clip or math.inf
                self._replay = TrainingReplay(self.model, self.parameters, self.optimizer, self.average, clip, windows, largest)
            self._replay.step(windows, self.generator, rate, self._decay())
        else:
            self._step(windows.to(self.device), rate, progress)
        state["step"] += 1
        if self.processes.leads and self.step % self.settings.log_every == 0:
            self._settle()
            count = state["logged"]
            if count == 0:  # all were skipped
                return
            mean = state["loss_sum"] / count
            if self.board:
                self.board.add_scalar("loss", mean, self.step)
                self.board.add_scalar("learning rate", rate, self.step)
            self.log.add(self.step, f"{self.seconds():.3f}", repr(mean), repr(rate), repr(state["norm_sum"] / count), frames)
            state["loss_sum"], state["norm_sum"], state["logged"] = 0.0, 0.0, 0
            self._show(mean, rate)

    def _step(self, windows: Windows, rate: float, progress: float) -> None:
        try:
            loss = self.model.loss(windows, self.generator, progress)
        except FloatingPointError as error:  # a call of the model whose result the next one, of an unrolled loss, cannot begin from
            self._diverged(str(error))
        for parameter in self.parameters:
            parameter.grad = None
        loss.backward()
        loss_value = self._join(float(loss.detach()), windows)
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.settings.gradient_clip or math.inf)
        norm_value = float(norm)
        if not (math.isfinite(loss_value) and math.isfinite(norm_value)):
            self._diverged(f"loss = {loss_value}, gradient norm = {norm_value}")
        self.optimizer.step(rate)
        self._update_average()
        self.progress_state["loss_sum"] += loss_value
        self.progress_state["norm_sum"] += norm_value

    def _diverged(self, what: str) -> NoReturn:
        kept = "checkpoint.pt keeps good weights" if (self.folder / "checkpoint.pt").is_file() else "no checkpoint was written yet"
        raise RunError(
            f"{self.folder}: step {self.step}: {what}: training diverged; {kept}; "
            f"start again with a smaller training.learning_rate (now {self.settings.learning_rate:g})"
        )

    def _settle(self) -> None:
        """Learn what became of replayed steps."""
        if self._replay is None:
            return
        loss, norm, bad, full = self._replay.settle()
        self.progress_state["loss_sum"] += loss
        self.progress_state["norm_sum"] += norm
        if bad:
            self._diverged(f"{bad} steps with a loss or a gradient that is not finite")
        if full:
            self.progress_state["logged"] -= full
            self._say(f"step {self.step}: {full} steps had larger graphs than there was room for and were skipped; there is more room now")

    def _join(self, loss: float, windows: Windows) -> float:
        """The loss and, in place, the gradient of the whole batch: those of the processes, weighted by the particles they are means over."""
        if windows.place is None:
            return loss
        share = len(windows.example) / windows.place[1]
        if KINEMATIC_TYPE in self.spec.particle_types:
            moving = float((windows.particle_type != KINEMATIC_TYPE).sum())
            share = moving / self.processes.add([], [moving])[0]
        for parameter in self.parameters:
            if parameter.grad is not None:
                parameter.grad.mul_(share)
        return self.processes.add(self.parameters, [share * loss])[0]

    def _decay(self) -> float:
        """d = min(decay, (1 + n) / (10 + n)), so that the first steps are soon forgotten."""
        return min(self.settings.average_decay, (1 + self.step) / (10 + self.step)) if self.settings.average_decay else 0.0

    @torch.no_grad()
    def _update_average(self) -> None:
        """average <- d average + (1 - d) weights."""
        decay = self._decay()
        current = self.model.state_dict()
        averaged = [name for name, value in current.items() if value.is_floating_point()]
        torch._foreach_lerp_([self.average[name] for name in averaged], [current[name] for name in averaged], 1 - decay)
        for name in set(current) - set(averaged):
            self.average[name].copy_(current[name])

    @contextmanager
    def _averaged(self) -> Iterator[nn.Module]:
        """The model with the averaged weights, in evaluation mode."""
        own = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.model.load_state_dict(self.average)
        self.model.eval()
        try:
            yield self.model
        finally:
            self.model.load_state_dict(own)
            self.model.train()

    # -- validation ----------------------------------------------------------------------------------------------------------

    def _validation_due(self, progress: float) -> bool:
        state = self.progress_state
        if self.step == 0 or state["validated_step"] == self.step:
            return False
        if progress >= 1:
            return True
        if self.settings.validate_every:
            return self.step % self.settings.validate_every == 0
        return math.floor(progress * self.settings.validations) > state["validations"]

    def _validate(self) -> None:
        self._settle()
        state, begun = self.progress_state, time.perf_counter()
        with self._averaged() as model:
            scores = []
            for trajectory in self.trajectories:
                if self._stop:
                    raise _Interrupted
                self._rolling = True
                try:
                    scores.append(rollout_score(model, trajectory, self.settings.validation_frames))
                finally:
                    self._rolling = False
            mse = float(np.mean([score[0] for score in scores]))
            ratio = float(np.mean([score[1] for score in scores]))
            finished = float(np.mean([score[2] for score in scores]))
            best = state["best_mse"] is None or mse < state["best_mse"]
            state["validated_step"] = self.step
            state["validations"] = math.floor(self.progress() * self.settings.validations)
            state["validation_seconds"] += time.perf_counter() - begun
            if best:
                # JSON has no infinity: a model none of whose rollouts finished is the largest number.
                state["best_mse"], state["best_step"] = min(mse, sys.float_info.max), self.step
                save_model(self.folder / "best.pt", model, self._provenance())
        if self.board:
            self.board.add_scalar("rollout MSE", mse, self.step)
        self.validation.add(self.step, f"{self.seconds():.3f}", repr(mse), repr(ratio), repr(finished), int(best))
        self._say(f"step {self.step}: validation rollout MSE {mse:.4g}, spacing ratio {ratio:.3f}{', best' if best else ''}")
        self._checkpoint()

    def _provenance(self) -> dict:
        return {
            "config": self._config_dict(),
            "step": self.step,
            "seconds": self.seconds(),
            "rollout_mse": self.progress_state["best_mse"],
            "scene": self.train_data.content.get("scene"),
            "trajectories": len(self.train_data),
            "device": str(self.device),
            "versions": {"sluice": __version__, "torch": torch.__version__},
        }

    # -- keeping -------------------------------------------------------------------------------------------------------------

    def _checkpoint(self) -> None:
        self._settle()
        self.log.sync()
        self.validation.sync()
        self.progress_state["seconds"] = self.seconds()
        state = {
            "config": self._config_dict(),
            "spec": json.loads(json.dumps(self.spec.to_dict())),
            "model": self.model.state_dict(),
            "average": self.average,
            "optimizer": self.optimizer.state(),
            "sampler": self.sampler.state(),
            "generator": self.generator.get_state(),
            "torch_random": torch.get_rng_state(),
            "device_random": [torch.cuda.get_rng_state(self.device)] if self.device.type == "cuda" else [],
            "progress": dict(self.progress_state),
        }
        assert set(state) == set(STATE_KEYS)
        save_state(self.folder / "checkpoint.pt", state)
        self._saved_at = time.perf_counter()

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """SIGTERM and SIGINT end the current step, or break off the current validation rollout; both lead to a checkpoint."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(number: int, _: object) -> None:
            self._stop = signal.Signals(number).name
            if self._rolling:
                raise _Interrupted

        before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    # -- telling -------------------------------------------------------------------------------------------------------------

    @contextmanager
    def _bar(self) -> Iterator[None]:
        """A progress bar in thousandths of the budget on a terminal, nothing elsewhere."""
        bar = tqdm(total=1000, unit="", bar_format="{l_bar}{bar}| {elapsed}<{remaining}{postfix}") if sys.stderr.isatty() else nullcontext()
        with bar as self._tqdm:
            yield

    def _show(self, loss: float, rate: float) -> None:
        if self._tqdm is not None:
            self._tqdm.n = round(1000 * self.progress())
            self._tqdm.set_postfix_str(f"step {self.step}, loss {loss:.4g}")
        elif time.perf_counter() - self._printed_at >= 10:
            self._printed_at = time.perf_counter()
            self._say(f"step {self.step} ({100 * self.progress():.0f} %, {self.seconds():.0f} s): loss {loss:.4g}, learning rate {rate:.3g}")

    def _say(self, line: str) -> None:
        tqdm.write(line, file=sys.stderr)


@torch.no_grad()
def rollout_score(model: nn.Module, trajectory: Trajectory, frames: int | None) -> tuple[float, float, float]:
    """(MSE, spacing ratio, finished) of a rollout of ``frames`` frames (None: to the end) from the start of ``trajectory``.

    MSE: mean over frames, moving particles and axes, length^2, infinite for a rollout that failed; spacing ratio: mean distance to
    the nearest neighbour in the last frame, predicted over true, nan if failed; finished: 1 or 0.
    """
    truth = trajectory.position[model.history :][:frames]
    result = rollout(model, start_from(trajectory, model.history), len(truth))
    if result.status != "ok":
        return math.inf, math.nan, 0.0
    moving = trajectory.moving
    truth = truth[:, moving]
    predicted = periodic.beside(result.position[:, moving], truth, trajectory.period)
    ratio = spacing_ratio(predicted[-1], truth[-1], trajectory.period)
    return float(frame_mse(predicted, truth).mean()), math.nan if ratio is None else ratio, 1.0


def _first_difference(one: object, other: object) -> str:
    """Dotted name of the first key in which two JSON-able dictionaries differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted(set(one) | set(other)):
            if key not in one or key not in other or one[key] != other[key]:
                below = _first_difference(one.get(key), other.get(key))
                return f"{key}.{below}" if below else str(key)
    return ""


def _at(content: object, key: str) -> object:
    for part in key.split("."):
        content = content.get(part) if isinstance(content, dict) else None
    return content


def train(config: Config, data: str | Path, run: str | Path, where: object = "config") -> dict:
    """Train to the end of the budget, resuming what ``run`` holds; returns the content of ``done.json`` (see ``Trainer``)."""
    return Trainer(config, data, run, where).run()
