"""Find the other inputs of a stage: those that flags name, else those along the source's provenance chain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import gdtool
from gdtool.core import sources
from gdtool.core.errors import UsageError
from gdtool.core.folder import Folder, open_folder
from gdtool.core.provenance import Origin, find_ancestor, missing_origin
from gdtool.core.sources import Source
from gdtool.core.stage import SecondInput, Stage


@dataclass(frozen=True)
class SecondInputs:
    """Hold the inputs beside the source, by the flag that names each: None for one that was not found.

    warnings: lines about inputs that a manifest lists and that do not exist any more.
    """

    by_flag: dict[str, Folder | Path | None]
    warnings: tuple[str, ...] = ()


def second_inputs(stage: Stage, source: Source, flags: dict[str, str | None]) -> SecondInputs:
    """Find each second input of a stage: the one that its flag names, else the one along the provenance chain.

    Raises InputError where a folder on the way there was replaced since, UsageError where a required one is missing.
    """
    by_flag: dict[str, Folder | Path | None] = {}
    warnings = []
    for flag in stage.second_inputs:
        wanted = stage.second(flag)
        by_flag[flag], gone = _find(stage, flag, wanted, source, flags.get(flag))
        if by_flag[flag] is not None:
            continue
        moved = f"{gone.path}, which {gone.of.kind} {gone.of.path} was made from, is gone" if gone else ""
        if wanted.required:
            raise UsageError(
                sources.name_of(source),
                moved or f"has no {wanted.kind} along its provenance chain",
                f"name one with --{flag}",
            )
        if moved:
            warnings.append(f"no {wanted.kind} found: {moved}; name one with --{flag} where there is one")
    return SecondInputs(by_flag, tuple(warnings))


def _find(
    stage: Stage, flag: str, wanted: SecondInput, source: Source, named: str | None
) -> tuple[Folder | Path | None, Origin | None]:
    """Find one second input; also returns the first input along the chain that is gone, where the search failed."""
    if named:
        kinds = (wanted.kind, sources.PICTURES) if wanted.foreign else (wanted.kind,)
        place = sources.hub_folder(named) if wanted.foreign else named
        opened = sources.resolve(place, kinds, f"--{flag} of {stage.name}")
        assert not isinstance(opened, str)  # second inputs are folders or files
        return opened, None
    if wanted.search and isinstance(source, Folder):
        cure = f"run the stages after it again, or name it with --{flag}"
        ancestor = find_ancestor(source, wanted.kind, cure)
        if ancestor is None:
            return None, missing_origin(source, cure)
        return open_folder(ancestor.path), None
    if wanted.default:
        return open_folder(Path(gdtool.__file__).parent / wanted.default, (wanted.kind,), stage.name), None
    return None, None
