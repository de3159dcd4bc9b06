"""Parts that several experiments use: claims, scores and figures. It imports no experiment."""
