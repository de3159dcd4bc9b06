"""What all experiments use: judged claims and figures."""
