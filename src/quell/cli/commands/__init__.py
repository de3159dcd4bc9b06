"""The commands: one file for each, with its options, its help and its work.

May import ``cli.options``, ``cli.output``, ``cli.report`` and ``cli.interrupt``; all other folders
only inside functions, so that ``quell --help`` is quick.
"""
