"""The golden corpus: results of one commit, so that what changes them is seen.

``corpus`` has recipes, stored data and comparison; ``loops``, ``results`` and ``kept`` the parts;
``draw`` and ``draw_axes`` made the cases once; ``make`` writes results again, with a reason.
"""
