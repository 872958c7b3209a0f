#!/usr/bin/env bash
# Makes this machine ready to build sat3d: silent when everything is there, installs what is
# missing with apt on Debian and Ubuntu, and says what is missing and how to get it elsewhere.
#
#   scripts/setup.sh            what the default build needs (GDAL, PROJ), and the tests' references
#   scripts/setup.sh --pure     what the pure-Rust build (--no-default-features) needs
#   scripts/setup.sh --peers    also what `make bench` compares with (rasterio)
#   scripts/setup.sh --check    install nothing, only say what is missing
set -euo pipefail

pure=0 peers=0 check=0
for argument in "$@"; do
    case "$argument" in
        --pure) pure=1 ;;
        --peers) peers=1 ;;
        --check) check=1 ;;
        -h | --help) sed -n '2,9s/^# \{0,1\}//p' "$0"; exit 0 ;;
        *) echo "setup: unknown argument $argument (see scripts/setup.sh --help)" >&2; exit 2 ;;
    esac
done

readonly minimum_rust=1.95
readonly minimum_proj=9.0
pure_hint="The pure-Rust build needs neither GDAL nor PROJ: cargo build --release --no-default-features
(or PURE=1 make demo). It reads GeoTIFF in the projections that docs/ARCHITECTURE.md lists."

say() { echo "setup: $*" >&2; }
have() { command -v "$1" >/dev/null 2>&1; }
# Whether version $1 is at least $2.
at_least() { [ "$(printf '%s\n%s\n' "$2" "$1" | sort -V | head -n 1)" = "$2" ]; }

# --- Rust ---------------------------------------------------------------------------------------
# A fresh rustup is on the PATH of new shells only.
if ! have cargo && [ -x "$HOME/.cargo/bin/cargo" ]; then
    PATH="$HOME/.cargo/bin:$PATH"
fi
if ! have cargo; then
    say "Rust is missing. Install Rust $minimum_rust or newer from https://rustup.rs, then run this again."
    exit 1
fi
rust=$(rustc --version | cut -d ' ' -f 2)
if ! at_least "${rust%%-*}" "$minimum_rust"; then
    say "Rust $rust is too old; sat3d needs $minimum_rust or newer (rustup update)."
    exit 1
fi

# --- What is missing ----------------------------------------------------------------------------
has_libclang() {
    [ -n "${LIBCLANG_PATH:-}" ] && return 0
    local pattern
    # Not libclang-cpp, which is another library and may be there alone.
    for pattern in '/usr/lib/llvm-*/lib/libclang*.so*' '/usr/lib/*/libclang*.so*' \
        '/usr/lib64/libclang*.so*' '/usr/lib/libclang*.so*' \
        /opt/homebrew/opt/llvm/lib/libclang.dylib /usr/local/opt/llvm/lib/libclang.dylib \
        /Library/Developer/CommandLineTools/usr/lib/libclang.dylib; do
        compgen -G "$pattern" | grep -v libclang-cpp && return 0
    done
    return 1
}

required=() optional=() packages=()
need() { # kind (required or optional), what it is, apt packages, test command...
    local kind=$1 what=$2 apt=$3
    shift 3
    "$@" >/dev/null 2>&1 && return 0
    if [ "$kind" = required ]; then required+=("$what"); else optional+=("$what"); fi
    # shellcheck disable=SC2206  # a list of package names
    packages+=($apt)
}
need required "make" "make" have make
need required "a C compiler, which links Rust programs" "gcc libc6-dev" have cc
if [ "$pure" = 0 ]; then
    need required "pkg-config" "pkg-config" have pkg-config
    need required "GDAL's headers" "libgdal-dev" pkg-config --exists gdal
    need required "PROJ's headers ($minimum_proj or newer)" "libproj-dev" \
        pkg-config --exists "proj >= $minimum_proj"
    # The declarations of PROJ's functions are made from its header at build time.
    need required "libclang" "libclang-dev" has_libclang
fi
# References that tests compare with; each such test says that it was skipped without them.
need optional "gdalwarp" "gdal-bin" have gdalwarp
need optional "cct and gie" "proj-bin" have cct
need optional "GeographicLib's ConicProj" "geographiclib-tools" have ConicProj
# Debian's Python, which `python3` need not be; scripts/test.sh takes whichever has them.
has_scipy() { python3 -c 'import scipy' || /usr/bin/python3 -c 'import scipy'; }
need optional "Python with numpy and scipy" "python3 python3-numpy python3-scipy" has_scipy
# Reports are opened in a real browser.
need optional "Chromium" "chromium" have chromium
# Looked for when the program runs: the large network is three to four times as fast with it.
has_onednn() { [ -n "${SAT3D_ONEDNN:-}" ] || compgen -G '/usr/lib/*/libdnnl.so.2'; }
apart=()
[ "$pure" = 0 ] && ! has_onednn >/dev/null && apart=(libdnnl2)
if [ "$peers" = 1 ]; then
    need optional "Python with rasterio" "python3 python3-rasterio" python3 -c "import rasterio"
fi
[ "${#packages[@]}" = 0 ] && [ "${#apart[@]}" = 0 ] && exit 0

list() { local text; text=$(printf '%s, ' "$@"); echo "${text%, }"; }
missing() { # all that is missing, in one line
    list ${required[@]+"${required[@]}"} ${optional[@]+"${optional[@]}"}
}

# Newer releases have only newer versions of it: by itself, so that the others do not fail with it.
without_onednn() {
    [ "${#apart[@]}" = 0 ] ||
        say "not there: oneDNN 2.6 (${apart[*]}). The large network will be slower, and its tests skipped."
}

# Ends the script: an error where something required is missing, a remark otherwise.
finish_without() { # how to get it
    without_onednn
    if [ "${#packages[@]}" = 0 ]; then exit 0; fi
    if [ "${#required[@]}" = 0 ]; then
        say "not there: $(missing). Tests that use it will say that they were skipped. $1"
        exit 0
    fi
    say "missing: $(missing)."
    say "$1"
    [ "$pure" = 0 ] && echo "$pure_hint" >&2
    exit 1
}

# --- Other systems ------------------------------------------------------------------------------
if ! have apt-get || ! have dpkg; then
    if have brew; then how="Try: brew install gdal proj pkgconf llvm geographiclib"
    elif have dnf; then how="Try: sudo dnf install gcc pkgconf gdal-devel proj-devel clang-devel gdal proj GeographicLib"
    elif have pacman; then how="Try: sudo pacman -S gcc pkgconf gdal proj clang geographiclib"
    elif have zypper; then how="Try: sudo zypper install gcc pkgconf gdal-devel proj-devel clang-devel gdal proj"
    elif have conda; then how="Try: conda install -c conda-forge gcc pkg-config gdal proj libclang geographiclib"
    else how="Install them with this system's package manager, then run this again."
    fi
    finish_without "$how"
fi

# --- Debian and Ubuntu --------------------------------------------------------------------------
# A release that is known, and has no oneDNN 2: nothing to try at every start.
if [ "${#apart[@]}" != 0 ] && apt-cache show libgdal-dev >/dev/null 2>&1 &&
    ! apt-cache show "${apart[@]}" >/dev/null 2>&1; then
    apart=()
    [ "${#packages[@]}" = 0 ] && exit 0
fi
command_line="apt-get install ${packages[*]} ${apart[*]}"
if [ "$check" = 1 ]; then
    finish_without "Try: sudo $command_line"
fi
as_root=()
if [ "$(id -u)" != 0 ]; then
    if ! have sudo; then
        finish_without "This needs an administrator: $command_line"
    fi
    # Without a terminal nobody can type a password.
    if [ -t 0 ]; then as_root=(sudo); else as_root=(sudo -n); fi
fi
say "installing ${packages[*]}${apart[*]:+ ${apart[*]}}"
log=$(mktemp)
trap 'rm -f "$log"' EXIT
run_apt() {
    ${as_root[@]+"${as_root[@]}"} env DEBIAN_FRONTEND=noninteractive \
        apt-get -y -q --no-install-recommends -o Acquire::Retries=2 "$@" >>"$log" 2>&1
}
# The lists of a fresh machine are empty, those of an old one outdated: try with them, then renew.
if [ "${#packages[@]}" != 0 ] && ! run_apt install "${packages[@]}" && ! { run_apt update && run_apt install "${packages[@]}"; }; then
    tail -n 5 "$log" >&2
    finish_without "apt could not install them (no network, or no rights?). By hand: sudo $command_line"
fi
if [ "${#apart[@]}" != 0 ]; then
    run_apt install "${apart[@]}" || { run_apt update && run_apt install "${apart[@]}"; } || without_onednn
    apart=()
fi
# An old release may have the package and still not the version.
if [ "$pure" = 0 ] && ! pkg-config --exists "proj >= $minimum_proj"; then
    say "this release's PROJ is $(pkg-config --modversion proj 2>/dev/null || echo absent); sat3d needs $minimum_proj or newer (Debian 12, Ubuntu 24.04)."
    echo "$pure_hint" >&2
    exit 1
fi
if [ "${#packages[@]}" != 0 ] && ! "$0" --check ${@+"$@"}; then
    exit 1
fi
