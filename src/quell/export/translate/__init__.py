"""Translation of kernels to C: functions of NamedTuples and arrays become functions of structs.

The syntax tree of each kernel is read together with the parameters and the state of a controller.
What compiled Python code knows (``kernels/sized.py``) is constant in C, too: shapes of arrays,
fields annotated with ``Size`` or ``Flag``, the implementations of generic functions. A branch that
is never taken, a loop without a pass and a number that never changes do not exist in C.

May import: ``kernels``.

``program.py`` is the whole, ``statements.py`` and ``expressions.py`` translate what is in a
function, ``structs.py`` defines the structs, ``text.py`` writes the lines of C.
"""
