"""The paper's hardware experiment on a twin of its torsional testbed, every claim judged."""
