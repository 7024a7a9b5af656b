"""The check of the adapters that a job refers to, apart from compilation, which many commands need without adapters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.bridge import adapter_spec, installed_adapters, suggest_reference
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.mapping.loader import MappingSpec, parameter_problem
from mosaico_ingest.adapters.python import is_python_allowed, is_python_reference, python_refusal
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.fields import (
    ParameterizedAdapter,
    reference_of,
)
from mosaico_ingest.job.manifest import refusal
from mosaico_ingest.job.model import Job


def check_adapters(job: Job) -> None:
    """Load every adapter that a job refers to.

    Raises:
        ManifestError: A reference has no usable adapter, or two adapters take one message type; `findings` has one
            finding per reference, with the rule and location that lint reports.
        AdapterError: An adapter file has mistakes.
    """
    findings: list[Finding] = []
    installed = installed_adapters() if job.adapters.python else ()
    names: dict[str, AdapterSpec] = {spec.name: spec for _, spec in installed}
    owners: dict[str, tuple[str, AdapterSpec]] = {}
    for position, reference in enumerate(job.adapters.load):
        spec = _load_adapter(job, ("adapters", "load", position), reference, names, findings)
        if spec is None:
            continue
        names[spec.name] = spec
        clash = next(
            (t for t in spec.ros_types if spec.default and owners.get(t, ("", spec))[1] != spec), None
        )
        if clash is not None:
            message = f"{reference} and {owners[clash][0]} both take {clash}"
            hint = "remove one, or set `default: false` in its file and name it in adapters.override"
            span = job.span("adapters", "load", position)
            findings.append(Finding("adapter-clash", Severity.ERROR, message, span, hint))
        owners.update({t: (str(reference), spec) for t in spec.ros_types if spec.default})
    for topic, reference in job.adapters.override.items():
        if not isinstance(reference, str) or reference not in names:
            _load_adapter(job, ("adapters", "override", topic), reference, names, findings)
    if findings:
        raise refusal(tuple(findings), job.origin.file or "adapters")


def _load_adapter(
    job: Job,
    path: tuple[str | int, ...],
    reference: object,
    names: Mapping[str, AdapterSpec],
    findings: list[Finding],
) -> AdapterSpec | None:
    """Return an adapter, or None with a finding about its reference."""
    if not (job.adapters.python and is_python_allowed()) and is_python_reference(reference_of(reference)):
        message, hint = python_refusal(str(reference))
        findings.append(Finding("python-refused", Severity.ERROR, message, job.value_span(*path), hint))
        return None
    wrong = tuple(_parameter_findings(job, path, reference))
    findings += wrong
    try:
        return adapter_spec(reference_of(reference) if wrong else reference, job.folder)
    except AdapterError as error:
        if error.findings:
            raise
        rule = _reference_rule(str(reference), error, job.folder)
        hint = (
            suggest_reference(str(reference), {*BY_NAME, *names}) if rule == "unknown-adapter" else error.hint
        )
        message = f"{error.where}: {error.what}" if error.where else error.what
        if rule == "missing-adapter":
            message, hint = _missing_adapter(str(reference), job.folder)
        findings.append(Finding(rule, Severity.ERROR, message, job.value_span(*path), hint))
        return None


def _parameter_findings(job: Job, path: tuple[str | int, ...], reference: object) -> Iterator[Finding]:
    """Yield a finding for each value in `with` that the adapter does not accept."""
    if not isinstance(reference, ParameterizedAdapter):
        return
    try:
        spec = adapter_spec(reference.file, job.folder)
    except AdapterError:
        return  # the caller reports it
    defaults = spec.model.parameters if isinstance(spec, MappingSpec) else {}
    for name, value in reference.values.items():
        problem, hint = parameter_problem(defaults, name, value)
        if problem is not None:
            span = job.value_span(*path, "with", name)
            yield Finding("adapter-parameter", Severity.ERROR, f"{reference}: {problem}", span, hint)


def _missing_adapter(reference: str, folder: Path) -> tuple[str, str]:
    """Return the message and the hint for a reference whose file or module does not exist."""
    module, colon, _ = reference.rpartition(":")
    file = module if colon else reference
    if file.endswith((".py", ".yaml", ".yml")):
        return (
            f"the file {folder / file} does not exist",
            "correct the path; it starts at the manifest's folder",
        )
    return f"the module {module} does not exist", f"install it, or put it into {folder}"


def _reference_rule(reference: str, error: AdapterError, folder: Path) -> str:
    """Return the rule that an unusable reference violates."""
    module, colon, _ = reference.rpartition(":")
    if not colon and not reference.endswith((".yaml", ".yml")):
        return "unknown-adapter"
    file = module if colon else reference
    is_file = file.endswith((".py", ".yaml", ".yml"))
    missing = not (folder / file).is_file() if is_file else isinstance(error.__cause__, ModuleNotFoundError)
    return "missing-adapter" if missing else "broken-adapter"
