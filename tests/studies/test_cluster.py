"""Studies on a Dask cluster: `executor=client`, and nothing else changes."""

from __future__ import annotations

import logging

import pytest

from ctmhe import Periodic, SendOnDelta, Study
from tests.studies.cases import Reactor, draw, troubled
from tests.studies.test_study import same


@pytest.fixture(scope="module")
def client():
    """Two worker processes on this machine."""
    distributed = pytest.importorskip("distributed")
    import dask

    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),  # else four workers have to die, each time
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def test_a_cluster_gives_the_numbers_of_one_process(client, tmp_path):
    """A real case with trajectories, written by the workers, and a cheap one; the client serves again afterwards."""
    study = Study(Reactor(), {"policy": [Periodic(0.1), SendOnDelta(0.1)]}, 2, folder=tmp_path, trajectories=True)
    result = study.run(executor=client)
    same(result, Study(Reactor(), {"policy": [Periodic(0.1), SendOnDelta(0.1)]}, 2).run())
    assert result.run(3).samples == result.table["samples"][3]
    many = Study(draw, {"gain": range(1, 11)}, 5)
    same(many.run(executor=client), many.run())


def test_a_worker_that_dies_costs_one_row(client):
    """What Dask gives up on is an error of that run; the others are computed, and the cluster goes on."""
    result = Study(troubled, {"kind": ["a", "dies", "raises"]}, 2).run(executor=client)
    assert result.failed["kind"].tolist() == ["dies", "raises"]
    assert result.failed["error"].iloc[0].startswith("KilledWorker: the process of this run died")
