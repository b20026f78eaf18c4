"""Campaigns on a Dask cluster: the same sums, workers that die, workers of other code."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
from distributed import Client, LocalCluster

from flasher.errors import UsageError
from flasher.simulate import cluster as clusters
from flasher.simulate import workers
from flasher.simulate.campaign import Batch, Result, batches, campaign_key, run_batch
from flasher.simulate.cluster import run_on_cluster
from flasher.simulate.workers import RunBatch

from .quick import (
    KILLER,
    no_result,
    run_endlessly,
    run_killing,
    run_killing_worker,
    run_quickly,
    run_slowly,
    text_of,
)
from .test_workers import expected, never, without_canaries

pytestmark = [
    pytest.mark.slow,
    # Of Dask itself, when workers end.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=100
    ) as made:
        yield made


def on_cluster(cluster: LocalCluster, some: list[Batch], run_one: RunBatch) -> Result:
    results = [no_result()]
    run_on_cluster(
        cluster.scheduler_address,
        some,
        on_result=lambda _batch, result: results.append(result),
        is_stopped=never,
        run_one=run_one,
    )
    return sum(results[1:], results[0])


def test_a_cluster_counts_what_one_process_does(cluster: LocalCluster) -> None:
    some = without_canaries(12, 12)
    assert text_of(on_cluster(cluster, some, run_batch)) == text_of(
        sum(map(run_batch, some), no_result())
    )


def test_the_run_that_ends_its_process_is_a_violation_and_all_others_count(
    cluster: LocalCluster,
) -> None:
    allowed = cluster.scheduler.allowed_failures
    found = on_cluster(cluster, [*batches(0, 60, 20)], run_killing)
    assert found.violations == expected(60).violations
    assert (found.runs, found.endings["killed"]) == (60, 1)
    assert sum(found.canaries_found.values()) == 1
    assert cluster.scheduler.allowed_failures == allowed


def test_a_run_without_an_end_is_a_violation_and_its_worker_lives_on(
    cluster: LocalCluster,
) -> None:
    """Which it has to without a nanny: no other one is started."""
    results = [no_result()]
    with Client(cluster.scheduler_address, set_as_default=False) as client:
        before = client.run(os.getpid)
        run_s = client.run(limit_runs, 0.2)
        give_up_s = time.perf_counter() + 120
        try:
            run_on_cluster(
                cluster.scheduler_address,
                [Batch(campaign_key(), KILLER, 1), Batch(campaign_key(), 0, 5)],
                on_result=lambda _batch, result: results.append(result),
                is_stopped=lambda: time.perf_counter() > give_up_s,
                run_one=run_endlessly,
            )
            assert client.run(os.getpid) == before
        finally:
            client.run(limit_runs, max(run_s.values()))
    found = sum(results[1:], results[0])
    assert found.runs == 6
    assert [(each.seed, each.text) for each in found.violations if each.kind == "KILLED"] == [
        (KILLER, "the run took more than 0.2 s of CPU time")
    ]


def limit_runs(run_s: float) -> float:
    """In a worker: change the time that a run may take; return what it was."""
    before = workers._RUN_S
    workers._RUN_S = run_s  # type: ignore[misc]
    return before


def test_a_worker_that_is_killed_changes_nothing(cluster: LocalCluster) -> None:
    some, results, killed = without_canaries(200, 200), [no_result()], list[int]()
    with Client(cluster.scheduler_address, set_as_default=False) as client:

        def kill_one(_batch: Batch, result: Result) -> None:
            results.append(result)
            if len(results) in (3, 6):
                killed.extend(client.run(os.getpid, on_error="ignore").values())
                with suppress(ProcessLookupError):
                    os.kill(killed[-1], signal.SIGKILL)

        run_on_cluster(
            cluster.scheduler_address,
            some,
            on_result=kill_one,
            is_stopped=never,
            run_one=run_slowly,
        )
    assert killed
    assert text_of(sum(results[1:], results[0])) == text_of(
        sum(map(run_quickly, some), no_result())
    )


def test_a_batch_that_no_worker_survives_ends_the_campaign(
    cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clusters, "ALLOWED_FAILURES", 0)
    with pytest.raises(UsageError) as lost:
        on_cluster(cluster, without_canaries(KILLER + 1, KILLER + 1), run_killing_worker)
    assert "1 workers died" in lost.value.cause


def test_a_stop_ends_the_campaign_and_leaves_the_cluster_as_it_was(cluster: LocalCluster) -> None:
    results: list[Result] = []
    run_on_cluster(
        cluster.scheduler_address,
        without_canaries(100_000, 100_000),
        on_result=lambda _batch, result: results.append(result),
        is_stopped=lambda: bool(results),
        run_one=run_slowly,
    )
    assert 0 < sum(each.runs for each in results) < 1000
    assert not any(name.startswith("flasher") for name in cluster.scheduler.worker_plugins)
    assert text_of(on_cluster(cluster, without_canaries(20, 20), run_slowly)) == text_of(
        sum(map(run_quickly, without_canaries(20, 20)), no_result())
    )


def test_workers_of_other_code_are_refused_with_both_versions(
    cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = clusters.CampaignPlugin(run_quickly)
    monkeypatch.setattr(clusters.CampaignPlugin, "__init__", other_code)
    with pytest.raises(UsageError) as refused:
        on_cluster(cluster, without_canaries(20, 20), run_quickly)
    assert f"has flasher {own.campaign} on Python {own.python};" in refused.value.what
    assert "has flasher 0123456789abcdef on Python 3.99.0." in refused.value.what
    assert "Install the same checkout" in refused.value.remedy


def other_code(plugin: clusters.CampaignPlugin, run_one: RunBatch = run_quickly) -> None:
    plugin.name, plugin.run_one = "flasher", run_one
    plugin.campaign, plugin.python = "0123456789abcdef", "3.99.0"


def test_a_worker_of_other_code_that_joins_is_closed() -> None:
    plugin = clusters.CampaignPlugin(run_quickly)
    other_code(plugin)
    with (
        LocalCluster(
            n_workers=0,
            threads_per_worker=1,
            processes=False,
            dashboard_address=":0",
            silence_logs=100,
        ) as made,
        Client(made, set_as_default=False) as client,
    ):
        client.register_plugin(plugin)
        made.scale(1)
        future = client.submit(os.getpid)
        with pytest.raises(TimeoutError):
            future.result(timeout=5)
        assert not client.nthreads()


def test_a_cluster_that_ends_is_reported() -> None:
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        dashboard_address=":0",
        silence_logs=100,
    ) as made:

        def end(_batch: Batch, _result: Result) -> None:
            made.close()

        with pytest.raises(UsageError, match="lost a batch") as lost:
            run_on_cluster(
                made.scheduler_address,
                without_canaries(1000, 1000),
                on_result=end,
                is_stopped=never,
                run_one=run_slowly,
            )
    assert "--ledger" in lost.value.remedy


def test_a_cluster_whose_workers_are_all_gone_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "_WORKER_S", 2.0)
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        dashboard_address=":0",
        silence_logs=100,
    ) as made:

        def end(_batch: Batch, _result: Result) -> None:
            made.scale(0)

        with pytest.raises(UsageError, match="lost a batch") as lost:
            run_on_cluster(
                made.scheduler_address,
                without_canaries(1000, 1000),
                on_result=end,
                is_stopped=never,
                run_one=run_slowly,
            )
    assert "had no worker" in lost.value.cause


def test_an_address_without_a_scheduler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "_CONNECT_S", 0.5)
    for address in ("127.0.0.1:1", "no address:x"):
        with pytest.raises(UsageError, match="No scheduler of a Dask cluster answers at"):
            run_on_cluster(
                address, [], on_result=lambda *_: None, is_stopped=never, run_one=run_quickly
            )


def test_no_client_begins_with_what_is_no_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that fails in its constructor is left half open."""
    monkeypatch.setattr(clusters, "Client", lambda *_, **__: pytest.fail("it has begun"))
    with pytest.raises(UsageError, match="No scheduler"):
        run_on_cluster(
            "nonsense", [], on_result=lambda *_: None, is_stopped=never, run_one=run_quickly
        )


def test_a_cluster_without_workers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "_WORKER_S", 0.2)
    with (
        LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=100) as made,
        pytest.raises(UsageError, match="has no worker"),
    ):
        on_cluster(made, [], run_quickly)
