"""The mast's self-check in service: hand-offs written down and weighed."""
