"""The registry of rules: the id, code, severity and summary of every finding and rejected row.

Each rule has a page, `docs/rules/<id>.md`. Lint, plan and run use the same ids; `ingest lint --explain ID` prints the page.
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.findings import Severity

_PACKAGE = Path(__file__).parent
_PAGE_FOLDERS = (_PACKAGE / "rule_pages", _PACKAGE.parent / "docs" / "rules")
"""The folder of the pages in an installed wheel, and in a checkout."""

_ERROR, _WARNING, _INFO = Severity.ERROR, Severity.WARNING, Severity.INFO


class Rule(Struct, frozen=True):
    """A rule that findings and rejected rows refer to."""

    code: str
    """The short name, such as `ING003`; its first digit is the group (see `GROUPS`)."""
    id: str
    """The name in kebab-case, such as `yaml-tag`."""
    severity: Severity
    """The default severity. Rejected rows have none of their own: `on_error` decides what they cause."""
    summary: str
    """The problem in one line: a noun phrase without a period."""

    @property
    def group(self) -> str:
        """The title of the group."""
        return GROUPS[self.code[3]]

    @property
    def is_lint(self) -> bool:
        """Whether `ingest lint` can report the rule."""
        return self.code[3] in _LINT_GROUPS


GROUPS = {
    "0": "YAML files and lint comments",
    "1": "Structure of manifests",
    "2": "Content of manifests",
    "3": "Message definitions",
    "4": "Adapter files",
    "5": "Recordings",
    "6": "Plans and runs",
    "7": "Rejected rows",
}
"""The title of each group, by the first digit of its codes."""

_LINT_GROUPS = "01234"

_TABLE = (
    Rule("ING001", "yaml-syntax", _ERROR, "a file that is not valid YAML"),
    Rule("ING002", "yaml-tab", _ERROR, "a tab in the indentation of a YAML file"),
    Rule("ING003", "yaml-tag", _ERROR, "an unquoted `!`, which starts a YAML tag"),
    Rule("ING004", "yaml-alias", _ERROR, "an unquoted `*`, which starts a YAML alias"),
    Rule("ING005", "yaml-anchor", _ERROR, "an unquoted `&`, or two YAML anchors with the same name"),
    Rule("ING006", "yaml-brace", _ERROR, "an unquoted `{`, which starts a YAML mapping"),
    Rule("ING007", "yaml-boolean", _ERROR, "an unquoted word that some YAML readers take for a boolean"),
    Rule("ING008", "yaml-number", _ERROR, "unquoted digits that YAML readers interpret differently"),
    Rule("ING009", "yaml-key", _ERROR, "a key that is not a string"),
    Rule("ING010", "yaml-merge", _ERROR, "a `<<` whose value is not a mapping"),
    Rule("ING011", "yaml-documents", _ERROR, "more than one YAML document in a file"),
    Rule("ING012", "yaml-depth", _ERROR, "values nested too deeply"),
    Rule("ING013", "yaml-size", _ERROR, "more values than a manifest may have"),
    Rule("ING014", "yaml-character", _ERROR, "a character that YAML does not allow"),
    Rule("ING015", "duplicate-key", _ERROR, "a key that occurs twice in a mapping"),
    Rule("ING016", "unreadable-file", _ERROR, "a file that cannot be read"),
    Rule("ING017", "not-utf8", _ERROR, "a file that is not encoded in UTF-8"),
    Rule("ING018", "unused-ignore", _WARNING, "an ignore comment that suppresses nothing"),
    Rule("ING019", "unknown-rule", _WARNING, "an ignore comment or a setting that names no rule of lint"),
    Rule("ING101", "empty-manifest", _ERROR, "a manifest without content"),
    Rule("ING102", "not-a-mapping", _ERROR, "a manifest that is not a mapping"),
    Rule("ING103", "missing-key", _ERROR, "a required key that is missing"),
    Rule("ING104", "unknown-key", _ERROR, "a key that does not exist"),
    Rule("ING105", "wrong-type", _ERROR, "a value of the wrong type"),
    Rule("ING106", "wrong-value", _ERROR, "a value that is not allowed"),
    Rule("ING107", "empty-value", _ERROR, "a key without a value"),
    Rule("ING108", "conflicting-keys", _ERROR, "keys that exclude each other"),
    Rule("ING109", "newer-version", _ERROR, "a manifest for a newer version of this tool"),
    Rule("ING110", "unset-variable", _ERROR, "an environment variable that is not set"),
    Rule("ING111", "variable-syntax", _ERROR, "a `${` that does not start a valid variable"),
    Rule("ING201", "topic-pattern", _ERROR, "a topic pattern that cannot match any topic name"),
    Rule("ING202", "relative-topic", _WARNING, "a topic name without a leading slash"),
    Rule("ING203", "overridden-pattern", _WARNING, "a topic pattern that a later pattern cancels"),
    Rule("ING204", "repeated-pattern", _WARNING, "a topic pattern that an earlier pattern already covers"),
    Rule(
        "ING205",
        "early-exclusion",
        _WARNING,
        "an exclusion above the first topic pattern that includes anything",
    ),
    Rule("ING206", "sequence-name", _ERROR, "a sequence name that the platform rejects"),
    Rule("ING207", "unknown-placeholder", _ERROR, "an unknown placeholder in the sequence name"),
    Rule("ING208", "name-without-placeholder", _ERROR, "a fixed sequence name for a glob of recordings"),
    Rule("ING209", "metadata-key", _ERROR, "a metadata key that is invalid or reserved"),
    Rule("ING210", "metadata-number", _ERROR, "a metadata number that JSON cannot represent"),
    Rule("ING211", "changed-number", _WARNING, "a metadata number that loses digits"),
    Rule("ING212", "distro-missing", _WARNING, "a `.db3` recording without a ROS distribution"),
    Rule("ING213", "distro-mismatch", _WARNING, "a ROS distribution of the other ROS version"),
    Rule("ING214", "unknown-format", _WARNING, "a recording with an unknown file name extension"),
    Rule("ING215", "mixed-formats", _ERROR, "splits of one recording in different formats"),
    Rule("ING216", "repeated-split", _ERROR, "a split that is listed twice"),
    Rule("ING217", "missing-definitions", _ERROR, "a path in `custom_msgs` without message definitions"),
    Rule("ING218", "repeated-definition", _ERROR, "a message type that is defined twice"),
    Rule("ING219", "unknown-adapter", _ERROR, "an adapter name that does not exist"),
    Rule("ING220", "broken-adapter", _ERROR, "a Python adapter that cannot be used"),
    Rule("ING221", "unreachable-key", _WARNING, "a glob that an earlier glob hides"),
    Rule("ING222", "excluded-topic", _WARNING, "a setting for a topic that `topics` excludes"),
    Rule("ING223", "topic-name", _ERROR, "a new topic name that the platform rejects"),
    Rule("ING224", "renamed-glob", _ERROR, "one new name for all topics that a glob matches"),
    Rule("ING225", "name-clash", _ERROR, "two topics with the same name in the sequence"),
    Rule("ING226", "plaintext-secret", _ERROR, "an API key or password written into a manifest"),
    Rule("ING227", "unencrypted-key", _WARNING, "an API key that is sent without encryption"),
    Rule("ING228", "readable-secret", _ERROR, "a secret in a file that every user can read"),
    Rule("ING229", "delete-permission", _WARNING, "`session: delete` with a key that may not delete"),
    Rule("ING230", "contradictory-policies", _WARNING, "a topic error policy that never applies"),
    Rule("ING231", "empty-time-range", _ERROR, "a time range that selects nothing"),
    Rule("ING232", "missing-file", _ERROR, "a file that the job needs and that does not exist"),
    Rule("ING233", "missing-folder", _WARNING, "a report path in a folder that does not exist"),
    Rule("ING234", "overwritten-input", _ERROR, "a report that would overwrite an input of the job"),
    Rule("ING235", "path-outside", _WARNING, "a relative path that leaves the repository"),
    Rule("ING236", "machine-path", _WARNING, "a path that exists only on one machine"),
    Rule("ING237", "idle-jobs", _INFO, "parallel jobs for a single recording"),
    Rule("ING238", "missing-adapter", _ERROR, "an adapter file or module that does not exist"),
    Rule("ING239", "missing-base", _ERROR, "an `extends` entry that cannot be used"),
    Rule("ING240", "wrong-url", _ERROR, "a URL that cannot be used"),
    Rule("ING241", "adapter-clash", _ERROR, "two loaded adapters for the same message type"),
    Rule("ING242", "image-setting", _WARNING, "an `image` setting for topics that are not images"),
    Rule("ING243", "expectation-bounds", _ERROR, "an expectation whose bounds are missing or contradictory"),
    Rule("ING244", "metadata-schema", _ERROR, "metadata that violates its schema"),
    Rule("ING245", "invalid-schema", _ERROR, "a metadata schema that cannot be used"),
    Rule("ING246", "lock-file", _ERROR, "a lock file that does not exist or cannot be used"),
    Rule("ING247", "python-refused", _ERROR, "an adapter in Python in a job that refuses Python"),
    Rule("ING250", "adapter-parameter", _ERROR, "a parameter that an adapter file does not have or accept"),
    Rule("ING260", "event-file", _ERROR, "an event file that cannot be used"),
    Rule("ING261", "event-interval", _ERROR, "an event whose end is not later than its start"),
    Rule("ING262", "event-overlap", _WARNING, "events that overlap"),
    Rule("ING301", "msg-syntax", _ERROR, "a line of a `.msg` file that is not a declaration"),
    Rule("ING302", "msg-unknown-type", _ERROR, "a field whose type is not defined"),
    Rule("ING303", "msg-repeated-name", _ERROR, "two declarations with the same name"),
    Rule("ING304", "msg-field-name", _WARNING, "a field name that ROS 2 rejects"),
    Rule("ING305", "msg-constant-name", _WARNING, "a constant name that ROS 2 rejects"),
    Rule("ING401", "unknown-field", _ERROR, "a field that the message type does not have"),
    Rule("ING402", "unknown-column", _ERROR, "a column that the ontology type does not have"),
    Rule("ING403", "missing-column", _ERROR, "a required column that the adapter does not fill"),
    Rule("ING404", "unknown-ontology", _ERROR, "an ontology type that does not exist"),
    Rule("ING405", "unknown-function", _ERROR, "a function that does not exist"),
    Rule("ING406", "function-arguments", _ERROR, "a function call with the wrong arguments"),
    Rule("ING407", "expression-syntax", _ERROR, "text that is not a valid expression"),
    Rule("ING408", "operand-type", _ERROR, "an operator or function applied to a value of the wrong type"),
    Rule("ING409", "type-mismatch", _ERROR, "a value that does not fit its column"),
    Rule("ING410", "field-form", _ERROR, "a field with missing, conflicting or useless keys"),
    Rule("ING411", "adapter-file", _ERROR, "an adapter file that is inconsistent"),
    Rule("ING412", "adapter-cycle", _ERROR, "adapters that use each other in a cycle"),
    Rule("ING413", "unchecked-adapter", _INFO, "an adapter for a message type whose definition is unknown"),
    Rule("ING414", "ambiguous-text", _ERROR, "an unquoted word in a `map` to text"),
    Rule("ING501", "unreadable-range", _WARNING, "a part of a recording that cannot be read"),
    Rule("ING502", "recovered-range", _INFO, "damage in a recording that lost no message"),
    Rule("ING503", "missing-split", _WARNING, "a split that `metadata.yaml` lists and that does not exist"),
    Rule("ING504", "single-split", _INFO, "one split of a recording that has several"),
    Rule("ING505", "metadata-unreadable", _WARNING, "a `metadata.yaml` that cannot be read"),
    Rule("ING506", "metadata-differs", _INFO, "a `metadata.yaml` that contradicts the recording"),
    Rule("ING507", "container-note", _INFO, "a note about how a recording is read"),
    Rule("ING508", "skipped-encoding", _WARNING, "a topic whose encoding cannot be decoded"),
    Rule("ING509", "mixed-types", _WARNING, "a topic with messages of several types or definitions"),
    Rule("ING510", "unreadable-definition", _WARNING, "a definition in the recording that cannot be parsed"),
    Rule("ING511", "assumed-definition", _INFO, "a definition that the recording does not contain"),
    Rule("ING512", "padded-messages", _WARNING, "messages with unexplained zero bytes at their end"),
    Rule(
        "ING513", "undeclared-fields", _WARNING, "fields of JSON messages that their schema does not declare"
    ),
    Rule("ING520", "split-gap", _WARNING, "a missing number among the splits of a recording"),
    Rule("ING521", "grouped-splits", _INFO, "files that are read as the splits of one recording"),
    Rule("ING601", "unmatched-pattern", _WARNING, "a topic pattern that matches no topic of the recording"),
    Rule("ING602", "skipped-topic", _INFO, "a topic that is not ingested"),
    Rule("ING603", "adapter-override", _INFO, "a topic whose adapter the manifest chooses"),
    Rule("ING604", "schema-change", _WARNING, "a definition that differs from the one in earlier sequences"),
    Rule("ING605", "schema-change-unchecked", _WARNING, "`on_schema_change` with a server as destination"),
    Rule("ING606", "disk-space", _WARNING, "a disk that may be too small for the sequence"),
    Rule("ING607", "plan-failed", _ERROR, "a recording that cannot be planned"),
    Rule("ING608", "plan-drift", _ERROR, "a plan that no longer matches the recording or the job"),
    Rule("ING609", "unexpected-messages", _WARNING, "more messages than the recording's index promises"),
    Rule("ING610", "quarantined", _WARNING, "rejected messages in the quarantine"),
    Rule("ING611", "old-server", _WARNING, "a server whose own clients cannot decode the rows"),
    Rule(
        "ING612", "static-topic", _WARNING, "a static topic whose messages before the time range are not read"
    ),
    Rule("ING613", "time-range-outside", _ERROR, "a time range that selects nothing of the recording"),
    Rule("ING614", "expectation-failed", _ERROR, "a recording that violates its data contract"),
    Rule("ING615", "expectation-skipped", _INFO, "an expectation that cannot be evaluated"),
    Rule("ING616", "expectation-explained", _INFO, "a gap that events of the recorder explain"),
    Rule(
        "ING617", "metadata-source", _WARNING, "a source of `metadata_from` that does not match the recording"
    ),
    Rule("ING618", "metadata-conflict", _WARNING, "two sources of `metadata_from` that differ"),
    Rule("ING619", "invalid-sidecar", _ERROR, "a side-car file of `metadata_from` that is not a JSON object"),
    Rule("ING620", "definition-difference", _ERROR, "a definition or column that differs from the lock file"),
    Rule("ING621", "run-failed", _ERROR, "a recording whose run ended with an error"),
    Rule("ING630", "latched-topic", _INFO, "a topic whose messages before the time range are included"),
    Rule("ING631", "no-publish-times", _WARNING, "`stamp: publish` for a recording without publish times"),
    Rule("ING640", "event-outside", _WARNING, "an event without messages in the recording"),
    Rule("ING641", "too-many-parts", _ERROR, "a `split` that makes too many sequences"),
    Rule("ING642", "empty-part", _INFO, "a part of a recording without rows"),
    Rule("ING643", "attachments-not-stored", _WARNING, "attachments that the destination cannot store"),
    Rule("ING644", "damaged-record", _WARNING, "a damaged attachment or metadata record of a recording"),
    Rule("ING645", "replaced-by-deletion", _INFO, "a replacement on a server, which cannot swap sequences"),
    Rule(
        "ING650", "no-inverse", _WARNING, "a topic that an export excludes because its adapter has no inverse"
    ),
    Rule("ING701", "decode", _WARNING, "bytes that do not fit their message type"),
    Rule("ING702", "definition", _WARNING, "a message type without a usable definition"),
    Rule("ING703", "encoding", _WARNING, "a message in an encoding that cannot be decoded"),
    Rule("ING704", "encapsulation", _WARNING, "an invalid CDR encapsulation header"),
    Rule("ING705", "pl-cdr", _WARNING, "a message encoded as a CDR parameter list"),
    Rule("ING706", "xcdr2", _WARNING, "a message encoded as XCDR2"),
    Rule("ING707", "truncated", _WARNING, "a message that ends too early"),
    Rule("ING708", "trailing-bytes", _WARNING, "a message that is longer than its type"),
    Rule("ING709", "sequence-length", _WARNING, "a list longer than the rest of its message"),
    Rule("ING710", "sequence-bound", _WARNING, "a list longer than its type allows"),
    Rule("ING711", "string-length", _WARNING, "a string longer than the rest of its message"),
    Rule("ING712", "string-terminator", _WARNING, "a string without its terminating NUL byte"),
    Rule("ING713", "utf8", _WARNING, "a string that is not valid UTF-8"),
    Rule("ING714", "utf16", _WARNING, "a wide string that is not valid UTF-16"),
    Rule("ING715", "too-large", _WARNING, "a message larger than 2 GiB"),
    Rule("ING716", "batch-size", _WARNING, "a batch whose values do not fit one Arrow column"),
    Rule("ING717", "protobuf", _WARNING, "bytes that are not a valid protobuf message"),
    Rule("ING718", "json-syntax", _WARNING, "bytes that are not valid JSON"),
    Rule("ING719", "json-schema", _WARNING, "a JSON message that violates its schema"),
    Rule("ING720", "json-value", _WARNING, "a JSON value that does not fit its column"),
    Rule("ING721", "adapter-rejected", _WARNING, "a row that a Python adapter refuses"),
    Rule("ING722", "adapter-error", _WARNING, "a batch in which the adapter fails"),
    Rule("ING723", "null", _WARNING, "a null in a column that requires a value"),
    Rule("ING724", "out-of-range", _WARNING, "a number that does not fit the type of its column"),
    Rule("ING725", "list-length", _WARNING, "a list of the wrong length"),
    Rule("ING726", "overflow", _WARNING, "a calculation that exceeds 64 bits"),
    Rule("ING727", "division", _WARNING, "a division without a result"),
    Rule("ING728", "number-syntax", _WARNING, "text that is not a number"),
    Rule("ING729", "nanosec", _WARNING, "a time with 1,000,000,000 or more nanoseconds"),
    Rule("ING730", "unmapped", _WARNING, "a value that a `map` does not list"),
    Rule("ING731", "point-cloud", _WARNING, "a point cloud whose layout contradicts its data"),
    Rule("ING732", "image-encoding", _WARNING, "an image that the selected image format cannot store"),
    Rule("ING741", "not-written", _WARNING, "a row that did not reach the destination"),
    Rule("ING742", "topic-closed", _WARNING, "a row of a topic that had already failed"),
    Rule("ING743", "topic-refused", _WARNING, "a row that the destination refuses"),
)

RULES = {rule.id: rule for rule in _TABLE}
"""Every rule by id, in the order of the codes."""

LINT_RULES = {rule.id: rule for rule in _TABLE if rule.is_lint}
"""The rules that `ingest lint` reports, by id."""

_BY_CODE = {rule.code: rule for rule in _TABLE}


def find_rule(name: str) -> Rule | None:
    """Return the rule with this id or code, or None."""
    return RULES.get(name) or _BY_CODE.get(name)


def page_of(rule: Rule) -> str:
    """Return the documentation page of a rule as Markdown."""
    folder = next(folder for folder in _PAGE_FOLDERS if folder.is_dir())
    return (folder / f"{rule.id}.md").read_text(encoding="utf-8")


def rule_index() -> str:
    """Return a Markdown table of all rules for each group."""
    tables = [
        f"\n## {group}\n\n| code | rule | severity | problem |\n|---|---|---|---|\n{''.join(map(_row, rules))}"
        for group, rules in groupby(RULES.values(), key=lambda rule: rule.group)
    ]
    return (
        "# Rules\n\nAfter reading this page, you can look up a finding of lint, plan or run, or the reason of a rejected row. "
        "`ingest lint --explain RULE` prints the same page.\n" + "".join(tables)
    )


def _row(rule: Rule) -> str:
    return f"| {rule.code} | [{rule.id}]({rule.id}.md) | {rule.severity.value} | {rule.summary} |\n"
