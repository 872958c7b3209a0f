#!/usr/bin/env bash
# Mutation testing of the numeric modules (docs/mutation.md): cargo-mutants changes an operator, a value or a
# result, and the module's unit tests must notice. Prints what they did not notice, and the score.
#
#   scripts/mutants.sh 3/40                        one shard of 40, numbered from 0: every 40th mutant from the fourth on
#   scripts/mutants.sh 3/40 crs model              only of these groups: crs (with grid), lidar, eval, tile, model
#   scripts/mutants.sh 0/1 crs 'conic.rs:7[0-9]:'  only mutants whose name matches (cargo mutants --re)
#
# Works on a copy of the last commit, with the changes to files that Git knows, in target/mutants; results stay in
# target/mutants/out. Exit code: 0 when the run is complete, whatever it found; 1 when a tool failed; 2 bad usage.
set -euo pipefail
cd "$(dirname "$0")/.."

usage() { sed -n '2,10s/^# \{0,1\}//p' "$0"; }
case "${1:-}" in
    -h | --help) usage; exit 0 ;;
    [0-9]*/[0-9]*) shard=$1; shift ;;
    *) usage >&2; exit 2 ;;
esac
groups=() only=
for argument in "$@"; do
    case "$argument" in
        crs | lidar | eval | tile | model) groups+=("$argument") ;;
        *) only=$argument ;;
    esac
done
[ ${#groups[@]} -gt 0 ] || groups=(crs lidar eval tile model)
if ! cargo mutants --version >/dev/null 2>&1; then
    echo "mutants: cargo-mutants is not installed; cargo install --locked cargo-mutants" >&2
    exit 1
fi

work=$PWD/target/mutants tree=$PWD/target/mutants/tree
# Unit tests need no debug information, and linking is a good part of what a mutant costs.
export CARGO_TARGET_DIR=$work/target CARGO_PROFILE_DEV_DEBUG=0 CARGO_TERM_COLOR=never
# What a property test found is not kept: it would test the next mutant with the last one's counterexample.
export PROPTEST_FAILURE_PERSISTENCE=off

# Keeps only some of the modules that a file names.
keep() { # file, modules...
    local file=$1
    shift
    awk -v keep=" $* " '
        function name(line) { sub(/^.*(mod|use) /, "", line); sub(/[^a-z0-9_].*/, "", line); return line }
        /^#\[cfg\(/ { held = $0 "\n"; next }
        /^pub use [a-z]/ || /^(pub |pub\(crate\) )?mod [a-z0-9_]+;/ {
            if (index(keep, " " name($0) " ")) printf "%s%s\n", held, $0
            held = ""
            next
        }
        { printf "%s%s\n", held, $0; held = "" }' "$file" >"$file.kept"
    mv "$file.kept" "$file"
}

# The copy. Only files that differ are written, so that a build goes on from the last one.
copy() {
    local commit
    commit=$(git stash create)
    [ -d "$tree/.git" ] || git clone --quiet --shared --no-checkout . "$tree"
    git -C "$tree" checkout --quiet --force --detach "${commit:-$(git rev-parse HEAD)}"
}

# A mutant of a projection need not compile the viewer, nor anything the network: what a group does not need is
# cut out of the copy, and a mutant takes seconds instead of minutes.
cut() { # modules of the root library...
    keep "$tree/src/lib.rs" oracle sat3d_model "$@"
    keep "$tree/src/plan/mod.rs"
    keep "$tree/src/lidar/mod.rs" hard_cases lattice pixel_map resample warp
    keep "$tree/src/eval/mod.rs" align hard_cases metrics protocol registration resize summary surface
    local errors=$tree/src/raster/mod.rs
    sed -n '1,/^$/p; /^use std::path/p; /^#\[derive(Debug, thiserror::Error)\]/,/^}/p' "$errors" >"$errors.kept"
    mv "$errors.kept" "$errors"
    printf 'pub mod layout;\npub mod sums;\n' >"$tree/src/tile/mod.rs"
    keep "$tree/crates/sat3d-model/src/lib.rs" error exact field illumination mesh preprocess random render scene tensor
    keep "$tree/crates/sat3d-model/tests/suite/main.rs" \
        mesh_parity mesh_scene mesh_skimage mesh_support mesh_topology render_city render_numerics
    sed -i '/^burn = /d; s/"burn\/[a-z]*"//' "$tree/crates/sat3d-model/Cargo.toml"
}

run() { # group, package, files of other groups, targets, names of tests...
    local name=$1 package=$2 others=$3 targets=() out=$work/out/${shard/\//-of-}-$1 code=0 target
    for target in $4; do targets+=("--cargo-arg=$target"); done
    shift 4
    rm -rf "$out"
    mkdir -p "$out"
    echo "== $name, shard $shard"
    (cd "$tree" && cargo mutants --in-place --package "$package" ${others:+--exclude "$others"} ${only:+--re "$only"} \
        --shard "$shard" --sharding round-robin --output "$out" --colors never \
        "${targets[@]}" -- -- "$@") || code=$?
    case $code in # 2: some were missed; 3: some ran out of time
        0 | 2 | 3) outs+=("$out/mutants.out") ;;
        *) failed=1; echo "mutants: cargo-mutants ended with $code in the group $name; see $out" >&2 ;;
    esac
}

failed=0 outs=()
for group in "${groups[@]}"; do
    copy
    case $group in
        crs) cut crs grid units; run crs sat3d 'src/{lidar,eval,tile}/**' --lib grid:: crs:: ;;
        lidar) cut crs grid lidar raster units; run lidar sat3d 'src/{grid,crs,eval,tile}/**' --lib lidar:: ;;
        eval) cut batch eval plan; run eval sat3d 'src/{grid,crs,lidar,tile}/**' --lib eval:: ;;
        tile) cut tile; run tile sat3d 'src/{grid,crs,lidar,eval}/**' --lib tile:: ;;
        model) cut crs; run model sat3d-model '' '--lib --test=suite' ;;
    esac
done

echo
[ ${#outs[@]} -eq 0 ] || for kind in caught missed timeout unviable; do
    for out in "${outs[@]}"; do sed "s/^/$kind /" "$out/$kind.txt"; done
done | awk '
    function row(name, caught, missed, timeout, unviable, to) {
        tested = caught + missed + timeout
        printf "%-36s %6d %6d %7d %8d   %s\n", name, caught, missed, timeout, unviable, \
            tested ? sprintf("%.1f %%", 100 * (caught + timeout) / tested) : "-" | to
    }
    { split($2, at, ":"); sub(/\/[^\/]*$/, "", at[1]); n[at[1], $1]++; seen[at[1]]; all[$1]++ }
    END {
        printf "%-36s %6s %6s %7s %8s   %s\n", "folder", "caught", "missed", "timeout", "unviable", "score"
        for (f in seen) row(f, n[f, "caught"], n[f, "missed"], n[f, "timeout"], n[f, "unviable"], "sort")
        close("sort")
        row("all", all["caught"], all["missed"], all["timeout"], all["unviable"], "cat")
    }'
exit "$failed"
