"""Combine a preset with an ablation, a configuration file and single values."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from gdtool.core.errors import InputError, UsageError
from gdtool.core.reading import read_json
from gdtool.diffusion.config import ABLATIONS, MOST_STEPS, PRESETS, SHAPE_TRAINING, ModelConfig, TrainConfig


def configuration(
    preset: str, part: str, ablation: str, file: str | None, values: Mapping[str, int | str], size: int | None
) -> tuple[ModelConfig, TrainConfig]:
    """Build the configurations of a preset, changed by an ablation, then by a file, then by values.

    Args:
        preset: a name in PRESETS.
        part: "views" or "shape", the part of the model that is trained.
        ablation: a name in ABLATIONS.
        file: path of JSON {"model": {...}, "train": {...}} with fields of ModelConfig and TrainConfig, or None.
        values: fields of TrainConfig.
        size: image size in pixels that the model is resized to at last, or None.

    Returns:
        The model's and the training's configuration. Raises InputError for a file or a size that does not fit.
    """
    model, train = PRESETS[preset]
    if part == "shape":
        if model.shape is None:
            raise UsageError("--part shape", f"preset {preset} has no shape network", "use --preset volume")
        train = SHAPE_TRAINING
    parts = [msgspec.to_builtins(fields) for fields in (model, train)]
    for fields, changes in zip(parts, ABLATIONS[ablation], strict=True):
        fields.update(changes)
    if file is not None:
        path = Path(file)
        try:
            changes = msgspec.convert(read_json(path), dict[Literal["model", "train"], dict])
        except msgspec.ValidationError as error:
            raise InputError(
                path, str(error), 'write {"model": {...}, "train": {...}} with names and values of docs/training.md'
            ) from None
        for fields, name in zip(parts, ("model", "train"), strict=True):
            fields.update(changes.get(name, {}))
    parts[1].update(values)
    try:
        model, train = msgspec.convert(parts[0], ModelConfig), msgspec.convert(parts[1], TrainConfig)
    except msgspec.ValidationError as error:
        raise InputError(file or "configuration", str(error), "correct that value in the file of --config") from None
    if size is not None:
        from gdtool.diffusion.network.grow import resize_config

        model = resize_config(model, size)
    return model, train


def chosen_configuration(options: Any) -> tuple[ModelConfig, TrainConfig]:
    """Return the configurations that the options of `gdtool train` choose. Raises InputError and UsageError."""
    # Without --steps the minutes decide when the training ends.
    steps = MOST_STEPS if options.minutes is not None and options.steps is None else options.steps
    precision = None if options.precision == "auto" else options.precision
    flags = {"steps": steps, "batch": options.batch, "precision": precision}
    values = {name: value for name, value in flags.items() if value is not None}
    return configuration(options.preset, options.part, options.ablation, options.config, values, options.size)
