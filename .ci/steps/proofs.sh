# shows: exported controllers are proved; a wrong one is not; hostile calls, style and further proofs in turn
# after: environment tools
cd "$OWN"
if command -v frama-c >/dev/null; then
    quell tune --num 1 --den 1,3,3,1 --dt 0.02 --structure poles --out tuned.toml
    for precision in double single; do
        quell export tuned.toml --out "proved-$precision" --name servo --precision $precision \
            $([ $precision = single ] && echo --accept) --prove
        sh "proved-$precision/proof/prove.sh"
    done
    sed -i 's/applied = limits->high;/;/' proved-double/src/servo.c
    if sh proved-double/proof/prove.sh; then echo "a u without upper limit was proved"; exit 1; fi
    python "$ROOT/.ci/checks/proof_with_learner.py" proved-learner
    python "$ROOT/benchmarks/proofs.py" --part $((TURN % 60 + 1))/60
else
    echo "NOT proved: there is no frama-c here"
fi
if command -v gcc >/dev/null; then
    python "$ROOT/benchmarks/hostile_exports.py" --calls 2e5 --part $((TURN % 8 + 1))/8
else
    echo "NOT tried: there is no gcc here"
fi
if command -v cppcheck >/dev/null; then python "$ROOT/benchmarks/exported_style.py" --part $((TURN % 24 + 1))/24; fi
