"""Parts that several experiments use: claims, scores and figures.

May import ``records`` and ``files``, and no experiment.
"""
