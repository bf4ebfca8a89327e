"""Studies on clusters of processes of this machine, on small disks, and in readers that know nothing of them."""

import os
import subprocess
import threading
import time

import numpy as np
import pytest
import zarr

import liethermo as lt

from .cases import RATES, content, study

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def long_study(store, **changes):
    """A study of many chunks of a tenth of a second."""
    axes = {"rate": RATES, "ratio": np.linspace(0.1, 0.6, 64)}
    return study(store, axes, t_span=(0.0, 400.0), step=0.01, **changes)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    store = tmp_path_factory.mktemp("clusters") / "whole.zarr"
    assert long_study(store).run().complete
    return content(store)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_any_number_of_workers_makes_the_same_store(workers, whole, tmp_path):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        assert long_study(tmp_path / "s.zarr").run(client, progress=True).complete
    assert content(tmp_path / "s.zarr") == whole


@pytest.mark.slow
def test_a_worker_that_dies_and_one_that_comes_lose_nothing(whole, tmp_path):
    from distributed import Client, LocalCluster

    store, told = tmp_path / "s.zarr", []

    def disturb(cluster):
        while not store.exists() or not (len(list((store / "status/c").rglob("*"))) > 20 or told):
            time.sleep(0.01)
        pids = [worker.pid for worker in cluster.workers.values()]
        cluster.scale(3)
        os.kill(pids[0], 9)
        told.append(long_study(store).status())

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        thread = threading.Thread(target=disturb, args=(cluster,))
        thread.start()
        assert long_study(store).run(client).complete
        thread.join()
        client.wait_for_workers(3, timeout=60)  # a process takes longer to start than what is left to do
    assert 0 < told[0].done < told[0].points
    assert told[0].running["pid"] == os.getpid()
    assert content(store) == whole


@pytest.mark.slow
def test_a_disk_that_fills(whole, tmp_path):
    """A file system of its own, too small for the study, and then a larger one."""
    place = tmp_path / "small"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "none", str(place)], capture_output=True)
    if mounted.returncode:
        pytest.skip("only root can mount")
    try:
        with pytest.raises(lt.FileError, match=r"the disk is full .*What is done is kept"):
            long_study(place / "s.zarr").run()
        status = long_study(place / "s.zarr").status()
        assert 0 < status.done < status.points
        subprocess.run(["mount", "-o", "remount,size=64m", str(place)], check=True)
        assert long_study(place / "s.zarr").run().complete
        assert content(place / "s.zarr") == whole
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_zarr_alone_reads_a_store(tmp_path):
    """The files are written here; ``zarr`` is the independent program that says they are what they should be."""
    found = study(tmp_path / "s.zarr", names={"rate": "friction"}, units={"rate": "1/s", "tau": "s"})
    found.run()
    for consolidated in (True, False):
        group = zarr.open_group(tmp_path / "s.zarr", mode="r", use_consolidated=consolidated)
        assert group.metadata.zarr_format == 3
        results = found.results
        for name in ("tau", "final", "laws", "status", "message", "rate", "quantity"):
            values = np.asarray(group[name][...])
            wanted = results[name].values
            assert np.array_equal(values, wanted, equal_nan=values.dtype.kind == "f"), name
            assert group[name].metadata.dimension_names == results[name].dims
    assert group["rate"].attrs.asdict() == {"units": "1/s", "long_name": "friction"}
    assert group["tau"].attrs["units"] == "s"
    assert "pickle" not in str(group.metadata)
