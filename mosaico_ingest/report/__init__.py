"""Reports: events of a run in; a report, its HTML page, its Markdown summary and its metrics out.

The package must not depend on the pipeline that emits the events or on a terminal.
"""
