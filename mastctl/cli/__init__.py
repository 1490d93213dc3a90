"""The command line: one parser, one way of telling results and refusals, one module a family of commands."""
