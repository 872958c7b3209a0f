#!/usr/bin/env bash
# Everything that CI checks. Each stage runs even if one before it failed; the summary comes last.
# Full logs stay in target/test-logs/.
set -uo pipefail
cd "$(dirname "$0")/.."

logs=target/test-logs
mkdir -p "$logs"
rm -f "$logs"/*.log
export CARGO_TERM_COLOR=never
# Everything is compiled once. What an interrupted incremental build leaves behind can fail to link.
export CARGO_INCREMENTAL=0
results=() failed=0

# Tests that compare with numpy take the Python that has it.
if [ -z "${SAT3D_TEST_PYTHON:-}" ] && ! python3 -c 'import scipy' 2>/dev/null &&
    /usr/bin/python3 -c 'import scipy' 2>/dev/null; then
    export SAT3D_TEST_PYTHON=/usr/bin/python3
fi

stage() { # name, command...
    local name=$1 log seconds
    log="$logs/${name//[^a-z0-9]/-}.log"
    shift
    printf '== %s\n' "$name"
    seconds=$SECONDS
    if "$@" >"$log" 2>&1; then
        awk '/^test result/ { gsub(/; finished.*/, ""); print "   " $0 }' "$log"
        results+=("$(printf '  ok       %-34s %5d s' "$name" $((SECONDS - seconds)))")
    else
        failed=1
        results+=("$(printf '  FAILED   %-34s %5d s   %s' "$name" $((SECONDS - seconds)) "$log")")
        # Of a test run what failed and why, of everything else the end.
        if grep -q '^failures:$' "$log"; then
            sed -n '/^failures:$/,$p' "$log" | head -n 300
        else
            grep -v '^ *\(Compiling\|Checking\|Downloaded\|Downloading\) ' "$log" | tail -n 100
        fi
    fi
}

skip() { # name, why
    results+=("$(printf '  skipped  %-34s %s' "$1" "$2")")
}

# Deny warnings on the command line and not in RUSTFLAGS, which would rebuild every dependency.
stage 'format' cargo fmt --check
stage 'lints' cargo clippy --locked --workspace --all-targets -- -D warnings
stage 'lints, pure' cargo clippy --locked --all-targets --no-default-features -- -D warnings
stage 'tests' cargo test --locked --workspace --no-fail-fast -- --show-output
# What differs without GDAL and PROJ: reading, coordinates, their messages, the bytes of a benchmark; every other
# test would only be linked once more.
pure=(cli raster_pure raster_bad_input crs_definitions dsm_bench_build dsm_bench_bad_input simulate)
stage 'tests, pure' cargo test --locked --no-fail-fast --no-default-features --lib --bins -- --show-output
stage 'tests, pure, end to end' cargo test --locked --no-fail-fast --no-default-features --test suite -- \
    --show-output "${pure[@]/%/::}"
stage 'documentation' env RUSTDOCFLAGS='-D warnings' cargo doc --locked --workspace --no-deps --document-private-items
if command -v cargo-deny >/dev/null; then
    stage 'licences and advisories' cargo deny --locked check
else
    skip 'licences and advisories' 'cargo-deny is not installed'
fi

printf '\nsummary\n'
printf '%s\n' "${results[@]}"
# Tests that lack a tool or data pass and say so; nobody should take that for tested.
skipped=$(grep -hE '^(SKIPPED|skipped)' "$logs"/tests*.log 2>/dev/null | sort | uniq -c)
if [ -n "$skipped" ]; then
    printf '\nparts of tests that were skipped (count, reason):\n%s\n' "$skipped"
fi
if [ "$failed" = 0 ]; then printf '\nall good, in %d s\n' "$SECONDS"; else printf '\nsomething FAILED\n'; fi
exit "$failed"
