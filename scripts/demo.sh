#!/usr/bin/env bash
# The demo: builds sat3d, runs the quickstart recipe into ./demo and says where to look.
# Arguments go to cargo (for example --no-default-features).
set -euo pipefail
cd "$(dirname "$0")/.."

echo "building sat3d (the first time, this takes minutes) ..."
cargo build --release --locked --quiet "$@"

started=$(date +%s)
target/release/sat3d run pipelines/quickstart.toml
echo
echo "pictures:"
find demo -name '*.png' -newermt "@$((started - 86400))" | sort | awk '
    { folder = $0; sub("/[^/]*$", "", folder)
      if (!(folder in count)) { order[++folders] = folder; first[folder] = $0 }
      count[folder]++ }
    END { for (i = 1; i <= folders; i++)
              printf "  %-40s %4d, for example %s\n", order[i] "/", count[order[i]], first[order[i]] }'
echo "took $(($(date +%s) - started)) s after the build; run it again and finished work is kept"
