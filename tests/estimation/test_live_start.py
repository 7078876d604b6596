"""Nothing is imported, compiled, loaded or designed once a live filter is made."""

import json
import os

import pytest
from fake_compilers import in_process, output_of, posix
from live_runs import UNTRAINED
from snippets import ROOT

EACH = """
import json, os, sys, types
import numpy as np
import pinnobs_gym
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.systems import SYSTEMS

def refused(*arguments, **settings):
    raise AssertionError("it was not ready")

def later(name, spec, y):
    "What is imported by samples, in a process that has imported little before."
    system = SYSTEMS.resolve(spec)()
    estimator = ESTIMATORS.resolve(name)(system)
    live = pinnobs_gym.Live(estimator, late="replay")
    import ctypes, subprocess
    before = set(sys.modules)
    observer_gains = sys.modules.get("pinnobs_gym.estimation.observer_gains", types)
    ctypes.CDLL = subprocess.Popen = observer_gains._remaining_error = refused
    for k in (0, 1, 3, 2, 4, 9, 20):
        estimate = live.update(0.01 * k, np.full(system.ny, np.nan) if k == 4 else y)
        estimate.xhat, estimate.std, estimate.nis
    live.predict(0.3)
    return sorted(set(sys.modules) - before)

for spec, (y, names) in json.loads(sys.argv[2]).items():
    for name in names:
        child = os.fork()
        if child == 0:
            with open(f"{sys.argv[1]}/{name}-{spec.rpartition(':')[2]}", "w") as file:
                try:
                    file.write(json.dumps(later(name, spec, y)))
                except BaseException as error:
                    file.write(json.dumps(repr(error)))
            os._exit(0)
        os.waitpid(child, 0)
"""
PLANTS = {
    "Academic": ([0.5], UNTRAINED),
    # It writes no Jacobians, and its angle is so uncertain that NumPy does the first samples.
    "many_plants:Cart": ([1.5, 3.0], ["ekf", "ukf"]),
}
"""Plants, outputs and estimators."""


@posix
@pytest.mark.parametrize("kernels", ["0", "1"])
def test_samples_import_compile_and_design_nothing(kernels, tmp_path):
    path = os.pathsep.join([str(ROOT / "tests" / "helpers"), str(ROOT / "scripts"), str(ROOT)])
    changes = {"PYTHONPATH": path, "PINNOBS_KERNELS": kernels}
    output_of(in_process(EACH, str(tmp_path), json.dumps(PLANTS), **changes))
    found = {file.name: json.loads(file.read_text()) for file in tmp_path.iterdir()}
    assert len(found) == sum(len(names) for _, names in PLANTS.values())
    assert {name: added for name, added in found.items() if added} == {}
