"""The plant's gain from a record of the running loop: its model, and prediction-error fits.

May import ``model`` and ``search``.
"""
