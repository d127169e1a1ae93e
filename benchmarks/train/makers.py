"""Make an object's views from its picture in several ways: by models, by inflation, and by training objects."""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import msgspec

from benchmarks.common.measure import Failed, gdtool, say
from benchmarks.train.baselines import TrainingObjects, digest_of, read_training_objects
from benchmarks.train.figures import SHOWN
from benchmarks.train.held_out import object_name
from benchmarks.train.inflate import Picture, inflated_views
from gdtool.core.folder import Folder, open_folder
from gdtool.core.kinds import DOMAINS
from gdtool.folders.views import Views, read_views
from gdtool.images.metrics import resized_views

BATCH = 25  # pictures that one run of sample-views takes: its start-up counts little in their seconds
_VERSION = "1"  # of the baselines: raise it when their views change


@dataclass(frozen=True)
class Held:
    """Hold one object that is measured on: its set, name, views folder and the six true views."""

    set_name: str
    folder: Folder

    @property
    def name(self) -> str:
        """Name of the object."""
        return object_name(self.folder)

    def views(self) -> Views:
        """Read the true views."""
        return read_views(self.folder, DOMAINS)


def picture_of(truth: Views) -> Picture:
    """Return the picture that all ways get: the true front view."""
    front = truth.names.index(SHOWN)
    return Picture(truth.images["color"][front], truth.mask[front], truth.cameras[front])


class Maker(Protocol):
    """Make views of a picture. name: for the tables. key: a digest of all that its views depend on."""

    name: str
    key: str
    has_shape: bool  # whether its silhouettes are some object's, so that pixels are shared with the others

    def prepare(self, objects: list[Held]) -> None:
        """Make ahead of time what takes a process of its own."""

    def views(self, held: Held, truth: Views) -> Views:
        """Return the views of an object, by the cameras of the truth."""

    def cost(self, held: Held) -> dict[str, float]:
        """Return "cpu_seconds" and "seconds" a picture, where that was measured."""


@dataclass
class ModelMaker:
    """Run `gdtool sample-views` with a model folder on the pictures, as they are framed.

    options: for sample-views. work: a folder where the views are kept, by the digest of the model's files.
    """

    name: str
    model: Path
    work: Path
    options: tuple[str, ...] = ()
    has_shape: bool = True
    key: str = field(init=False)

    def __post_init__(self) -> None:
        files = msgspec.json.encode(open_folder(self.model, ("model",)).manifest.files)
        self.key = hashlib.sha256(files + " ".join(self.options).encode()).hexdigest()[:16]

    def _folder(self, held: Held) -> Path:
        return self.work / self.key / held.set_name / f"{held.name}-{held.folder.manifest.key[:8]}"

    def prepare(self, objects: list[Held]) -> None:
        todo = [held for held in objects if not (self._folder(held) / "cost.json").exists()]
        for start in range(0, len(todo), BATCH):
            self._run(todo[start : start + BATCH])
            say(f"  {self.name}: {start + len(todo[start : start + BATCH])} of {len(todo)}")

    def _run(self, batch: list[Held]) -> None:
        """Sample the views of some objects in one process. A picture that fails has no folder afterwards."""
        with tempfile.TemporaryDirectory() as place:
            pictures = []
            for number, held in enumerate(batch):
                pictures.append(Path(place, f"{number:03d}.png"))
                shutil.copyfile(held.folder.path / "color" / f"{SHOWN}.png", pictures[-1])
            common = ("--no-crop", "--model", self.model, *self.options, "--quiet")
            one = ("-o", Path(place, "out", "000.asset", "views")) if len(batch) == 1 else ("-o", Path(place, "out"))
            seconds: dict[str, float] = {}
            try:
                cost = gdtool("sample-views", *pictures, *common, *one, limit_seconds=3600)
                seconds = {"cpu_seconds": cost.cpu_seconds / len(batch), "seconds": cost.seconds / len(batch)}
            except Failed as error:  # of one picture, as a rule
                say(f"  {self.name}: {error}")
            for number, held in enumerate(batch):
                made, target = Path(place, "out", f"{number:03d}.asset"), self._folder(held)
                if made.exists():
                    shutil.rmtree(target, ignore_errors=True)
                    shutil.copytree(made, target)
                    (target / "cost.json").write_text(json.dumps(seconds))

    def views_folder(self, held: Held) -> Path:
        """Return the folder of the views that were made of an object."""
        return self._folder(held) / "views"

    def views(self, held: Held, truth: Views) -> Views:
        """Read the views. Raises Failed where sample-views made none."""
        if not self.views_folder(held).exists():
            raise Failed(f"{self.name} made no views of {held.name}")
        return of_size(read_views(open_folder(self.views_folder(held), ("views",), check=False), DOMAINS), truth)

    def cost(self, held: Held) -> dict[str, float]:
        return json.loads((self._folder(held) / "cost.json").read_text())


@dataclass
class BaselineMaker:
    """Make views without a model. kind: inflated, nearest, constants or mean; training: what the last three need."""

    name: str
    kind: str
    key: str
    training: TrainingObjects | None = None

    @property
    def has_shape(self) -> bool:
        """The mean object has no silhouette of its own."""
        return self.kind != "mean"

    def prepare(self, objects: list[Held]) -> None:
        """Nothing: the views are made when they are asked for."""

    def views(self, held: Held, truth: Views) -> Views:
        picture = picture_of(truth)
        if self.kind == "inflated":
            return inflated_views(picture, truth.cameras)
        assert self.training is not None
        if self.kind == "nearest":
            return of_size(self.training.nearest(picture), truth)
        if self.kind == "constants":
            return self.training.constant_views(picture, truth.cameras)
        return self.training.mean_views(truth.cameras)

    def cost(self, held: Held) -> dict[str, float]:
        return {}


def of_size(views: Views, truth: Views) -> Views:
    """Return views at the truth's size and by its cameras, where their own size is another."""
    order = [views.names.index(name) for name in truth.names]
    images, mask = {d: x[order] for d, x in views.images.items()}, views.mask[order]
    return Views(truth.cameras, *resized_views(images, mask, *truth.mask.shape[1:]))


def baselines(folders: list[Folder], work: Path) -> list[BaselineMaker]:
    """Return the baselines; without training objects only the inflated silhouette."""
    made = [BaselineMaker("inflated silhouette", "inflated", f"inflated-{_VERSION}")]
    if folders:
        training, digest = read_training_objects(folders, work), digest_of(folders)
        names = {
            "nearest": "nearest training object",
            "constants": "constants",
            "mean": "mean training object",
        }
        made += [BaselineMaker(name, kind, f"{kind}-{_VERSION}-{digest}", training) for kind, name in names.items()]
    return made


def model_maker(text: str, work: Path) -> ModelMaker:
    """Read "NAME=FOLDER [OPTIONS]" with options of sample-views, or a folder alone, which names itself."""
    name, equals, rest = text.partition("=")
    folder, *options = shlex.split(rest if equals else text)
    return ModelMaker(name if equals else Path(folder).name, Path(folder), work, tuple(options))
