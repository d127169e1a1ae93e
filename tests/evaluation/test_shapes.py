"""Bring a model file into the frame of a result."""

import numpy as np
import pytest

from gdtool.core.errors import UsageError
from gdtool.evaluation.shapes import Shape, aligned_truth, normalised_vertices

FACES = np.array([[0, 1, 2]])
TRUTH = Shape(np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0.0]]), FACES)
CENTRED = np.array([[-0.5, -0.25, 0], [0.5, -0.25, 0], [-0.5, 0.25, 0]])  # of TRUTH, longest side 1


def result(matrix):
    return Shape(CENTRED, FACES, source_from_world=matrix)


def similarity(scale, shift):
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = shift
    return matrix


def test_source_undoes_the_similarity_of_the_result():
    aligned = aligned_truth(TRUTH, result(similarity(2.0, (1, 0, 0))), "source")
    np.testing.assert_allclose(aligned, (TRUTH.vertices - (1, 0, 0)) / 2)


def test_box_centres_the_model_with_longest_side_one():
    np.testing.assert_allclose(aligned_truth(TRUTH, result(np.eye(4)), "box"), CENTRED)


def test_auto_takes_the_box_for_a_result_from_a_picture():
    np.testing.assert_allclose(aligned_truth(TRUTH, result(np.eye(4)), "auto"), CENTRED)


def test_auto_takes_the_similarity_of_a_result_that_has_one():
    np.testing.assert_allclose(aligned_truth(TRUTH, result(similarity(4.0, (2, 1, 0))), "auto"), CENTRED)


def test_auto_leaves_two_files_as_they_are():
    np.testing.assert_array_equal(aligned_truth(TRUTH, result(None), "auto"), TRUTH.vertices)


def test_source_needs_a_result_that_is_a_folder():
    with pytest.raises(UsageError, match="needs a result that is a folder"):
        aligned_truth(TRUTH, result(None), "source")


def test_an_asset_in_its_source_frame_is_normalised():
    asset = Shape(TRUTH.vertices, FACES, source_from_world=similarity(4.0, (2, 1, 0)), in_source_frame=True)
    np.testing.assert_allclose(normalised_vertices(asset), CENTRED)
