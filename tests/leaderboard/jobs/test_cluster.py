"""Encrypted connections to a Dask scheduler."""

import shutil
import subprocess

import dask
import pytest
from distributed import LocalCluster
from distributed.security import Security

from pinnobs_gym.leaderboard.jobs.cluster import connected

NOTHING = {"ca-file": None, "client.key": None, "client.cert": None}


def configured(files):
    return dask.config.set({f"distributed.comm.tls.{name}": file for name, file in files.items()})


def test_what_tls_needs_is_named(tmp_path):
    with configured(NOTHING), pytest.raises(ValueError, match=r"needs ca-file, client\.key and"):
        connected("tls://127.0.0.1:1").__enter__()
    missing = dict.fromkeys(NOTHING, str(tmp_path / "missing.pem"))
    with configured(missing), pytest.raises(ValueError, match=r"cannot read the files.*No such"):
        connected("tls://127.0.0.1:1").__enter__()
    (tmp_path / "missing.pem").write_text("no certificate")
    with configured(missing), pytest.raises(ValueError, match="cannot read the files"):
        connected("tls://127.0.0.1:1").__enter__()


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl here")
def test_an_encrypted_scheduler_is_reached_with_dasks_configuration(tmp_path):
    key, cert = str(tmp_path / "key.pem"), str(tmp_path / "cert.pem")
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost"]
    subprocess.run([*make, "-keyout", key, "-out", cert], check=True, capture_output=True)
    files = {"ca-file": cert}
    for role in ("scheduler", "worker", "client"):
        files |= {f"{role}.key": key, f"{role}.cert": cert}
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    with (
        configured(files),
        dask.config.set({"distributed.comm.require-encryption": True}),
        LocalCluster(
            **options, protocol="tls://", security=Security(), dashboard_address=":0"
        ) as cluster,
        connected(cluster.scheduler_address) as pool,
    ):
        assert cluster.scheduler_address.startswith("tls://")
        assert pool.size == 1
