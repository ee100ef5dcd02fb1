"""Training steps of a grid emulator on a CUDA device, as one CUDA graph and kernel by kernel: ``python benchmarks/grid_cuda.py --data DATA``.

DATA: a data set of ``configs/scenes/sand.yaml`` (``sluice-sim generate configs/scenes/sand.yaml --split train --count 8 --out DATA``, and
``--split valid``). Steps as ``learn.train`` makes them: drawing the batch, selecting windows, noise, loss, gradient, clipping, optimiser and
the average of the weights. Means of steps that nobody waits for until the last, both forms in turns, medians of the rounds; ``host``: drawing and
selecting alone. The sums of the losses of the first ten steps of both forms, from the same weights and draws, are beside them.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch

from learn.train import Trainer, load_config
from sim.trajectory import write_json

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "models" / "sand_grid_gpu.yaml")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "grid_cuda.json")
    parser.add_argument("--steps", type=int, default=30, help="of a round")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("grid_cuda: left out, for this machine has no CUDA device that torch can use")
        return
    config = load_config(arguments.config, {"log_every": 10**9})
    result = {"device": torch.cuda.get_device_name(), "torch": torch.__version__, "config": config.model_dump(mode="json"), "steps": []}
    with tempfile.TemporaryDirectory() as folder:
        for number, calls in enumerate(config.settings["unroll"]):
            progress = (number + 0.5) / len(config.settings["unroll"])
            trainers = {}
            for form in ("graph", "kernels"):
                trainers[form] = Trainer(config, arguments.data, Path(folder) / form)
                trainers[form].replayed = form == "graph"
            found = {"calls": calls, "ms": {form: [] for form in (*trainers, "host")}, "losses": {}}
            for form, trainer in trainers.items():
                for _ in range(10):
                    trainer._train_step(progress)
                trainer._settle()
                found["losses"][form] = trainer.progress_state["loss_sum"]
            for _ in range(arguments.rounds):
                for form, trainer in trainers.items():
                    torch.cuda.synchronize()
                    begun = time.perf_counter()
                    for _ in range(arguments.steps):
                        trainer._train_step(progress)
                    torch.cuda.synchronize()
                    found["ms"][form].append(1e3 * (time.perf_counter() - begun) / arguments.steps)
                trainer = trainers["graph"]
                begun = time.perf_counter()
                for _ in range(arguments.steps):
                    trainer.model.pick(trainer.sampler.next(trainer.model.window(progress)), trainer.generator)
                found["ms"]["host"].append(1e3 * (time.perf_counter() - begun) / arguments.steps)
            trainers["graph"]._settle()
            found["ms"] = {form: statistics.median(times) for form, times in found["ms"].items()}
            result["steps"].append(found)
            print({name: value for name, value in found.items()})
    write_json(arguments.out, result)


if __name__ == "__main__":
    main()
