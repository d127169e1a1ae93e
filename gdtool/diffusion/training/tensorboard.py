"""Write a training's figures and validation pictures as TensorBoard event files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gdtool.core.errors import ResourceError

if TYPE_CHECKING:
    import numpy as np


class Events:
    """Write TensorBoard event files to a folder. Raises ResourceError without the package tensorboard.

    The files are created at the first record.
    """

    def __init__(self, folder: Path):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise ResourceError(
                "--tensorboard", "needs the package tensorboard", "pip install 'gdtool[tensorboard]', or leave it out"
            ) from None
        self._open, self._folder = SummaryWriter, folder
        self._writer: SummaryWriter | None = None

    def _at(self, step: int):
        """Return the writer. The first call creates it, and hides older events of this step and later ones."""
        # A resumed run repeats the steps since its checkpoint; purge_step hides their earlier events.
        if self._writer is None:
            self._writer = self._open(str(self._folder), purge_step=step, flush_secs=10)
        return self._writer

    def scalars(self, record: dict[str, float | int]) -> None:
        """Add the numbers of a step's record, under their names in loss.csv."""
        step = int(record["step"])
        for name, value in record.items():
            if name != "step":
                self._at(step).add_scalar(name, value, step)

    def picture(self, step: int, grid: np.ndarray) -> None:
        """Add a validation picture (h, w, 3) uint8."""
        self._at(step).add_image("validation", grid, step, dataformats="HWC")

    def close(self) -> None:
        """Close the event files."""
        if self._writer is not None:
            self._writer.close()
