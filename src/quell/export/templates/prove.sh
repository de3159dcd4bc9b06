#!/bin/sh
# Proves src/@name@.c with Frama-C 25 or later; ends with 0 if all is proved, else with 1.
# What is not proved is printed: file, line, function, kind, status, property.
#
# There are two runs: the state as it is, which is one object, and the same code with each array of
# the state as an object of its own (@name@_separate.h), so that none runs into the next one.
cd "$(dirname "$0")" || exit 1
if ! command -v frama-c >/dev/null; then
    echo "NOT proved: there is no frama-c here (Debian and Ubuntu: apt-get install frama-c-base)"
    exit 1
fi
if ! cmp -s ../src/@name@.h @name@_exported.h; then
    echo "NOT proved: src/@name@.h is not the header that was exported; export the controller again"
    exit 1
fi
judge() { # table of properties, log, what was analysed
    if ! grep -q "^\[eva:summary\]" "$2" || grep -Eq "by the (Eva analyzer|Frama-C kernel): +[1-9][0-9]* error" "$2" || [ ! -f "$1" ]; then
        tail -20 "$2"
        echo "NOT proved: Frama-C ended without a result for $3"
        exit 1
    fi
    awk -F '\t' -v what="$3" '
        $1 ~ /^FRAMAC_SHARE/ && ($5 == "assigns clause" || $5 == "from clause") { next }
        $2 ~ /_separate.h$/ && $6 == "Dead" { next }
        NR > 1 && $6 != "Valid" && $6 != "Considered valid" { print $2 ":" $3 ": " $4 ": " $5 ": " $6 ": " $7; bad++ }
        NR > 1 && $6 == "Valid" && /a_number: / { good++ }
        END { if (bad || !good) { print "NOT proved: " bad + 0 " properties are open for " what; exit 1 } }' "$1" || exit 1
}
rm -f properties.csv separate.csv
frama-c @options@ >eva.log 2>&1
judge properties.csv eva.log "the state as it is"
frama-c @separate@ >separate.log 2>&1
judge separate.csv separate.log "arrays of the state as objects of their own"
echo "Not judged here: reads beyond an array of constants, loops, recursion, rates of u; see REPORT.md"
echo "proved: no undefined behaviour, no array of the state is overrun, and u is always a number@limits@"
