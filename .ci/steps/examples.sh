# shows: half of the examples run
# after: environment tools
i=$TURN
for example in "$ROOT"/examples/*.py; do
    i=$((i + 1))
    if test $((i % 2)) = 0; then continue; fi
    echo "-- $example"
    (cd "$OWN" && python "$example")
done
