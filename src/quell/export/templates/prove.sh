#!/bin/sh
# Proves src/@name@.c with Frama-C 25 or later; ends with 0 if all is proved, else with 1.
# What is not proved is printed: file, line, function, kind, status, property.
cd "$(dirname "$0")" || exit 1
if ! command -v frama-c >/dev/null; then
    echo "NOT proved: there is no frama-c here (Debian and Ubuntu: apt-get install frama-c-base)"
    exit 1
fi
rm -f properties.csv
frama-c @options@ >eva.log 2>&1
if ! grep -q "^\[eva:summary\]" eva.log || grep -Eq "by the (Eva analyzer|Frama-C kernel): +[1-9][0-9]* error" eva.log || [ ! -f properties.csv ]; then
    tail -20 eva.log
    echo "NOT proved: Frama-C ended without a result"
    exit 1
fi
awk -F '\t' '
    $1 ~ /^FRAMAC_SHARE/ && ($5 == "assigns clause" || $5 == "from clause") { next }
    NR > 1 && $6 != "Valid" && $6 != "Considered valid" { print $2 ":" $3 ": " $4 ": " $5 ": " $6 ": " $7; bad++ }
    NR > 1 && $6 == "Valid" && /a_number: / { good++ }
    END {
        if (bad || !good) { print "NOT proved: " bad + 0 " properties are open"; exit 1 }
        print "proved: no undefined behaviour, and u is always a number within its limits"
    }' properties.csv
