"""Parts that several experiments use: judged claims, scores and figures. It imports no experiment."""
