# shows: extras in their newest versions, the lowest versions, packers of other projects: one of the three a day
# after: wheel
# minutes: 20
wheel=$(ls "$WORK"/dist/*.whl)
lists="python3 $ROOT/.ci/checks/requirements.py"
case $((DAY % 3)) in
0)  # All extras together in the newest versions, and two of them alone.
    for version in 3.11 3.13; do
        if ! "python$version" --version >/dev/null 2>&1; then echo "python$version is not here"; continue; fi
        "python$version" -m venv "$OWN/resolve-$version"
        resolve="$OWN/resolve-$version/bin/python -m pip install --quiet --dry-run --ignore-installed --only-binary :all:"
        for extra in $($lists some "$SEED") "$($lists all)"; do
            echo "$extra"
            $resolve "$wheel[$extra]" || { echo "$extra can't be installed on $version"; exit 1; }
        done
    done
    ;;
1)  # Part of the tests with the lowest allowed versions; their wheels are for Python 3.11 and 3.12.
    python3 -m venv "$OWN/lowest"
    $lists lowest >"$OWN/lowest.txt"
    $lists lowest-all >"$OWN/lowest-all.txt"
    "$OWN/lowest/bin/pip" install --quiet --only-binary :all: -r "$OWN/lowest.txt" pytest==8.2 pytest-xdist==3.8 hypothesis
    "$OWN/lowest/bin/pip" install --quiet --no-deps "$wheel"
    # The oldest matplotlib uses names that the newest pyparsing deprecates.
    NUMBA_CACHE_DIR="$OWN/cache" "$OWN/lowest/bin/python" -m pytest -q -n 1 -p no:cacheprovider \
        --no-budget -W ignore::DeprecationWarning -W ignore::PendingDeprecationWarning tests/test_types.py \
        tests/test_files.py tests/test_live.py tests/test_trajectory.py tests/test_signals.py \
        tests/test_lti_models.py tests/test_telemetry.py \
        tests/test_tuning_simulated.py tests/test_executors.py
    "$OWN/lowest/bin/pip" install --quiet --dry-run --ignore-installed --only-binary :all: -r "$OWN/lowest-all.txt"
    ;;
2)  # PlatformIO and ESP-IDF's component manager need other versions than quell's extras.
    python3 -m venv "$OWN/packers" "$OWN/venv"
    if "$OWN/packers/bin/pip" install --quiet platformio idf-component-manager; then
        mkdir "$OWN/programs"
        ln -s "$OWN/packers/bin/pio" "$OWN/packers/bin/compote" "$OWN/programs"
        "$OWN/venv/bin/pip" install --quiet "$wheel" pytest pytest-xdist hypothesis
        PATH="$OWN/venv/bin:$PATH:$OWN/programs" python -m pytest -q -n 0 --no-budget -m "" -p no:cacheprovider tests/test_packages.py
    else
        echo "NOT tried: PlatformIO or the component manager of ESP-IDF can't be installed here"
    fi
    ;;
esac
