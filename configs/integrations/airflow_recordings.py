"""An Airflow DAG that ingests every recording of a folder each night, with one mapped task per recording.

Copy it to the folder of DAGs and set the variables INGEST_RECORDINGS (a folder) and INGEST_MANIFEST of the workers. The
tasks start the command `ingest`, so that the tool may be installed in another environment than Airflow: set INGEST to
its path.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from airflow.exceptions import AirflowException, AirflowFailException, AirflowSkipException
from airflow.sdk import dag, task

INGEST = os.environ.get("INGEST", "ingest")
MANIFEST = os.environ.get("INGEST_MANIFEST", "configs/integrations/nightly.yaml")
RECORDINGS = os.environ.get("INGEST_RECORDINGS", "configs/quickstart")
NOTHING_MATCHED, PARTLY_REJECTED = 3, 4
FINAL = {2: "the manifest is wrong", 6: "the recording violates its contract"}
"""Exit codes of permanent failures; a retry returns the same code."""


@dag(schedule="0 2 * * *", start_date=datetime(2026, 1, 1, tzinfo=timezone.utc), catchup=False)
def nightly_recordings() -> None:
    """Ingest the recordings of a folder, and log the totals."""

    @task
    def list_recordings() -> list[str]:
        """Return the recordings; sequences that exist are skipped by the manifest."""
        return sorted(str(path.resolve()) for path in Path(RECORDINGS).glob("*.mcap"))

    @task(retries=2, retry_delay=timedelta(minutes=1), map_index_template="{{ recording }}")
    def ingest(path: str) -> dict[str, Any]:
        """Ingest one recording and return its totals; the task fails without retries after a permanent failure."""
        from airflow.sdk import get_current_context  # noqa: PLC0415 - exists in tasks only

        get_current_context()["recording"] = Path(path).name
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder) / "report.json"
            command = [INGEST, "run", MANIFEST, "--report", str(report)]
            code = subprocess.run(command, env={**os.environ, "RECORDING": path}, check=False).returncode  # noqa: S603 - our own command
            if code == NOTHING_MATCHED:
                raise AirflowSkipException(f"nothing in {path} matches the manifest")
            if code in FINAL:
                raise AirflowFailException(f"{path}: {FINAL[code]}; see the log")
            if code not in {0, PARTLY_REJECTED}:
                raise AirflowException(f"{path}: exit code {code}")
            (recording,) = json.loads(report.read_text())["recordings"]
        return {key: recording[key] for key in ("sequence", "status", "totals")}

    @task(trigger_rule="all_done")
    def summarize(reports: list[dict[str, Any]]) -> int:
        """Return the number of stored messages."""
        total = sum(report["totals"]["written"] for report in reports)
        print(f"{len(reports)} recordings, {total} messages")
        return total

    summarize(ingest.expand(path=list_recordings()))  # pyright: ignore - Airflow replaces the types of results


nightly_recordings()
