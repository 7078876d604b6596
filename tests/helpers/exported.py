"""Exported C files, compiled under sanitizers, and the estimates of a record that they give."""

import numpy as np
import pytest
from export_figures.built import COMPILER, FLAGS, SANITIZERS, csv_of, replay
from export_figures.built import build as build_files

from pinnobs_gym.estimation.export.c_files import c_files

needs_c = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")


def build(folder, estimator, prior, **options):
    """Write and compile the files of an estimator, and return the program that replays."""
    return build_files(folder, c_files(estimator, prior, "plant", **options), (*FLAGS, *SANITIZERS))


def assert_replays(program, estimator, record, tolerance):
    """Check that the program gives the estimates and standard deviations of the first row."""
    system = estimator.system
    record = record.rows(slice(0, 1))
    found, said = replay(program, csv_of(record, system))
    assert not said
    expected = estimator.run(record)
    scale = np.asarray(system.scale, dtype=float)
    error = system.state_residual(found[:, 1 : 1 + system.nx], expected.xhat[0]) / scale
    assert abs(error).max() <= tolerance
    if expected.P is not None:
        std = np.sqrt(np.einsum("kii->ki", expected.P[0]))
        assert (abs(found[:, 1 + system.nx :] - std) / scale).max() <= tolerance
