"""Data contracts: evaluates the section `expect` of a job.

The input is a plan's topics and the columns of their messages, batch by batch; the output is a `ContractResult`
(`report.parts`). The package must not depend on pipelines, executors or the command line.
"""
