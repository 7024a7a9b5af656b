"""The run of one recording: a configuration in, a committed sequence and a report out.

The stages are: plan, open the recording, check provenance, open the sink, decode, adapt, write, verify, report. The
package must not depend on the command line or on executors.
"""
