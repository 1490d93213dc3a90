"""The paper's experiments, run through the HTTP interface of any daemon, simulated or real."""
