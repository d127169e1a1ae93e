"""Arrange images in contact sheets."""

import numpy as np
import pytest

from gdtool.images.contact import contact_sheet


def test_cells_stand_at_their_row_and_column():
    red, clear = np.zeros((40, 40, 3)), np.zeros((40, 40, 4))
    red[..., 0] = 1
    sheet = contact_sheet([[red, None], [clear, np.full((20, 40), 0.5)]])
    assert sheet.dtype == np.uint8
    assert sheet.shape[2] == 3
    isolated = np.flatnonzero((sheet == (255, 0, 0)).all(-1).any(1))
    assert len(isolated) == 40
    assert (sheet == (255, 0, 0)).all(-1).sum() == 1600
    assert (sheet == 128).all(-1).sum() == 800
    assert (sheet[isolated[-1] + 5 :, :44] == 255).all()  # transparent is white


def test_labels_are_drawn():
    images = [[np.ones((64, 64, 3)), np.ones((64, 64, 3))]]
    assert (contact_sheet(images, ["color", "normal"], ["front"]) < 128).any()
    assert (contact_sheet(images) == 255).all()


def test_an_empty_contact_sheet_is_refused():
    with pytest.raises(ValueError):
        contact_sheet([[None]])
