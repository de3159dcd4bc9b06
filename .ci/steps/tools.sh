# shows: compilers, an emulator, a prover and a browser are here, where they can be installed
# A test that needs one of them is skipped without it, and says so.
tools="chromium clang cppcheck frama-c-base gcc-arm-none-eabi libnewlib-arm-none-eabi lld qemu-system-arm"
if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $tools; } \
        >"$OWN/apt.log" 2>&1 || tail -3 "$OWN/apt.log"
fi
for tool in gcc clang wasm-ld cppcheck frama-c arm-none-eabi-gcc qemu-system-arm chromium iec2c; do
    command -v "$tool" || echo "$tool is not here: tests that need it are skipped"
done
