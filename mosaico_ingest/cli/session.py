"""This file runs configurations with a display, writes the report and leaves with its exit code."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import ParamSpec

import typer

from mosaico_ingest import api
from mosaico_ingest.cli.collector import collect_as_usual
from mosaico_ingest.cli.log_format import LogFormat
from mosaico_ingest.cli.logs import JsonLines, set_up_logging
from mosaico_ingest.cli.signals import interrupt_on_terminate
from mosaico_ingest.cli.tally import Tally, sizes_of
from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.errors import SinkError
from mosaico_ingest.executors.executor import Executor
from mosaico_ingest.executors.local import Inline
from mosaico_ingest.report.events import BatchObserver, Event, RunFinished, ignore_batch
from mosaico_ingest.report.model import RunReport, UsedManifest
from mosaico_ingest.report.write import write_report
from mosaico_ingest.textfile import check_file

__all__ = ["run_configs"]

P = ParamSpec("P")


def run_configs(
    configs: Sequence[ROSInjectionConfig],
    *,
    report: Path | None,
    quiet: bool,
    log: str | None,
    jobs: int | None = None,
    executor: Executor | None = None,
    log_format: LogFormat = LogFormat.TEXT,
    manifests: Sequence[UsedManifest] = (),
    watching: BatchObserver = ignore_batch,
    finished: Callable[[RunReport], None] = lambda _result: None,
) -> None:
    """Run the configurations, several at a time where asked for; exit with the report's code unless it is 0."""
    level = log or (configs[0].log_level if configs else "INFO")
    prepare = partial(set_up_logging, level, log_format)
    prepare()
    interrupt_on_terminate()
    collect_as_usual()
    failures: list[RunFinished] = []
    targets = {path for path in (report, *map(_report_path, configs)) if path is not None}
    for target in targets:
        check_file(target)

    def tell(position: int, event: Event) -> None:
        if isinstance(event, RunFinished) and event.error is not None:
            failures.append(event)
        watching(position, event)
        observe(position, event)

    as_json = log_format is LogFormat.JSON
    with _display(configs, as_json=as_json, quiet=quiet) as observe:
        chosen = executor or _executor(configs, jobs, prepare)
        result = api.run(configs, executor=chosen, observe=tell, manifests=manifests)
    unwritten = [
        *_refusal(finished, result),
        *(one for target in targets for one in _refusal(write_report, result, target)),
    ]
    if not quiet and not as_json:
        from mosaico_ingest.cli.tables import print_report

        print_report(result)
    errors = [] if as_json else [(failure.error or "", failure.findings) for failure in failures]
    errors += [(str(error), error.findings) for error in unwritten]
    if errors:
        _print_errors(errors)
    code = SinkError.exit_code if unwritten and result.exit_code in {0, 4} else result.exit_code
    if code:
        raise typer.Exit(code)


def _display(
    configs: Sequence[ROSInjectionConfig], *, as_json: bool, quiet: bool
) -> AbstractContextManager[BatchObserver]:
    """Return what shows the run while it goes; what draws is slow to import, and only people want it drawn."""
    if quiet and not as_json:
        return nullcontext(ignore_batch)
    tally = Tally(sizes_of(configs) if len(configs) > 1 else [1] * len(configs))
    if as_json:
        return nullcontext(JsonLines(tally))
    from mosaico_ingest.cli.progress import display

    return display(tally)


def _refusal(write: Callable[P, None], *given: P.args, **named: P.kwargs) -> Iterator[SinkError]:
    """Yield what keeps a file from being written: it costs that file, not what else there is to say of the run."""
    try:
        write(*given, **named)
    except SinkError as error:
        yield error


def _print_errors(errors: Iterable[tuple[str, Sequence[Finding]]]) -> None:
    from mosaico_ingest.cli.errors import print_error

    for error, findings in errors:
        print_error(error, findings)


def _executor(
    configs: Sequence[ROSInjectionConfig], jobs: int | None, prepare: Callable[[], None]
) -> Executor:
    wanted = min(jobs or configs[0].jobs, len(configs)) if configs else 1
    if wanted == 1:
        return Inline()
    from mosaico_ingest.executors.processes import Processes

    return Processes(wanted, prepare=prepare)


def _report_path(config: ROSInjectionConfig) -> Path | None:
    return None if config.report_path is None else Path(config.report_path)
