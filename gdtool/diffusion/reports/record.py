"""Record a training run: validation pictures and TensorBoard events during it, the model folder's files at its end."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from gdtool.core.kinds import ModelContent
from gdtool.core.stage import Output
from gdtool.diffusion.checkpoint.weights import save_model
from gdtool.diffusion.config import TrainConfig
from gdtool.diffusion.data.objects import Objects, from_bytes
from gdtool.diffusion.inference import familiarity
from gdtool.diffusion.network.model import parameter_count
from gdtool.diffusion.reports.curve import draw_curve
from gdtool.diffusion.reports.report import append_validation, model_card, shape_validation, view_validation
from gdtool.diffusion.training import distributed
from gdtool.diffusion.training.loop import Observers, State
from gdtool.diffusion.training.tensorboard import Events
from gdtool.images.io import write_png

if TYPE_CHECKING:
    from gdtool.diffusion.training.worker import Order

MOST_PICTURES = 4000  # most objects whose pictures are measured for the ranges of figures
PICTURES_EACH = 2  # most condition images of an object that are measured


class Recorder:
    """Write validation pictures, validation.csv and TensorBoard events of a run into its workspace.

    train: of the run; its precision, "float32" or "bfloat16", is also that of sampling. tensorboard: whether to write
    events.
    """

    def __init__(self, workspace: Path, held_out: Objects, train: TrainConfig, tensorboard: bool):
        self.workspace, self.held_out, self.train = workspace, held_out, train
        (workspace / "validation").mkdir(exist_ok=True)
        self.events = Events(workspace / "tensorboard") if tensorboard else None

    def validate(self, state: State) -> None:
        """Sample the held-out objects, if there are any."""
        if not len(self.held_out):
            return
        if self.train.part == "shape":
            grid, figures = shape_validation(state, self.held_out)
        else:
            grid, figures = view_validation(state, self.held_out, self.train.precision)
        write_png(self.workspace / "validation" / f"step_{state.step:06d}.png", grid)
        append_validation(self.workspace / "validation.csv", state.step, state.seconds, figures)
        if self.events is not None:
            self.events.picture(state.step, grid)

    def observers(self, out: Output) -> Observers:
        """Return the functions that the training loop calls to report."""
        log = {} if self.events is None else {"log": self.events.scalars}
        return Observers(validate=self.validate, warn=out.warn, progress=out.progress, **log)

    def copy_to(self, out: Output) -> None:
        """Copy the loss curve, the validation and the events to the model folder."""
        if self.events is not None:
            self.events.close()
            for file in sorted((self.workspace / "tensorboard").iterdir()):
                shutil.copyfile(file, out.path(f"tensorboard/{file.name}"))
        shutil.copyfile(self.workspace / "loss.csv", out.path("loss.csv"))
        write_png(out.path("loss.png"), draw_curve(self.workspace / "loss.csv"))
        if len(self.held_out):
            shutil.copyfile(self.workspace / "validation.csv", out.path("validation.csv"))
        for picture in sorted((self.workspace / "validation").glob("*.png")):
            shutil.copyfile(picture, out.path(f"validation/{picture.name}"))


def write_results(
    out: Output, recorder: Recorder, state: State, objects: Objects, order: Order, preset: str, ablation: str
) -> None:
    """Write the model folder: averaged weights, loss curve, validation, ranges of the pictures, and model card.

    Sets the content of the folder's manifest as well.
    """
    save_model(out.path, order.model, state.average)
    recorder.copy_to(out)
    every = range(0, order.used, max(order.used // MOST_PICTURES, 1))
    pictures = (
        from_bytes(objects.conditions[i, k]).numpy()
        for i in every
        for k in range(min(PICTURES_EACH, objects.conditions.shape[1]))
    )
    familiarity.write_ranges(out.path(familiarity.RANGES_FILE), familiarity.figure_ranges(pictures))
    facts = {
        "objects": order.used,
        "steps": state.step,
        "training_minutes": round(state.seconds / 60, 1),
        "batch": order.train.batch,
        "parameters": parameter_count(state.model),
        "threads": out.threads,
        "device": out.device,
        "processes": distributed.size(),
        "ablation": ablation,
    }
    out.path("card.md").write_text(model_card(preset, order.model, order.train, facts))
    out.content = ModelContent(
        preset=preset,
        image_size=order.model.image_size,
        domains=order.model.domains,
        parameters=parameter_count(state.model),
        steps=state.step,
        report={k: v for k, v in facts.items() if k not in ("parameters", "steps", "threads")},
    )
