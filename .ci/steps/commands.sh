# shows: from a record to a model, a tuned controller, a sweep, C and an FMU
# after: environment tools
cd "$OWN"
quell excite input.csv --kind prbs --low 0.2 --high 20 --duration 60 --u-min -2 --u-max 2
python "$ROOT/.ci/checks/twin_record.py" input.csv record.csv
quell identify record.csv --friction --json model.json --figures figures
quell tune --num 1 --den 1,3,3,1 --dt 0.02 --out tuned.toml --json tune.json --figures figures
quell run tuned.toml --figures run-figures
cat >sweep.toml <<'TOML'
dt = 0.01
plant = { kind = "two-mass" }
observer = { kind = "model-free", order = 4, b0 = 1.0, omega_o = 10.0 }
controller = { omega_c = 1.0 }
scenario = { duration = 30.0, reference = { kind = "step" } }

[sweep]
draws = 500
metrics = ["iae", "overshoot"]
parameters = { "plant.m1" = { low = 0.6, high = 1.4 } }
TOML
quell sweep sweep.toml --figures figures
quell sweep sweep.toml --repeat 17 --figures figures
python "$ROOT/.ci/checks/model_and_tuning.py" model.json tune.json
python "$ROOT/.ci/checks/poles_far_apart.py"
python "$ROOT/.ci/checks/single_precision.py"
quell export tuned.toml --out servo-c --name servo
gcc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -Wpedantic -Wconversion -Werror -Iservo-c/src \
    servo-c/test_servo.c servo-c/src/servo.c -o test_servo -lm
./test_servo
quell export tuned.toml --to fmu --what loop --out loop.fmu
fmpy validate loop.fmu
fmpy simulate loop.fmu --stop-time 1 --output-file loop.csv
