# shows: format, rules, types, and the direction of imports; .ci/turn has been raised
# after: environment
ruff format --check .
ruff check .
mypy
# Without that the same parts would run again.
changed=$(python docs/part.py --changed)
if test -n "$changed" && ! grep -qx .ci/turn <<<"$changed"; then
    echo "NOT raised: .ci/turn chooses which parts of the trials and benchmarks run; add one to it before a change lands"
    exit 1
fi
