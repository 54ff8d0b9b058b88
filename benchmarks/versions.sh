#!/bin/sh
# The device side's tests on the oldest and the newest versions that pyproject.toml admits, on every
# Python that is here, from an installed wheel and without torch. `benchmarks/versions.sh [PYTHON ...]`;
# the interpreters default to those of 3.11, 3.12 and 3.13 on the path. $TESTS: pytest's arguments.
# One line for each environment at the end. $HOST_PYTHON has torch, and writes the bundle they use. Old
# versions may call each other by deprecated names.
set -eu

here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
host=${HOST_PYTHON:-$here/.venv-test/bin/python}
[ $# -gt 0 ] || set -- python3.11 python3.12 python3.13

# Nothing of the source tree but what tests read beside the package.
mkdir -p "$work/elsewhere"
cd "$here"
cp -R tests docs examples deploy benchmarks calib export sgm.pt ./*.md Makefile pyproject.toml "$work/elsewhere"
PYTHONPATH=$here:tests "$host" tests/random_bundle.py "$work/bundle"
"$host" -m pip wheel --disable-pip-version-check --quiet --no-deps -w "$work" .

oldest() {  # the lower bounds; Python 3.13 has wheels of later numpys only
    sed -n '/^dependencies/,/^]/s/^ *"\([a-z-]*\)>=\([0-9.]*\).*/\1==\2.*/p' "$here/pyproject.toml" |
        if "$1" -c 'import sys; sys.exit(sys.version_info < (3, 13))'; then
            sed 's/^numpy==.*/numpy==2.1.*/'
        else
            cat
        fi
}

summary=$work/summary
: > "$summary"
tried=0
broken=0
for python in "$@"; do
    # It has to run: a shim of pyenv's is on the path for versions that are not switched on, too.
    "$python" -c '' 2> /dev/null || { echo "$python: not here" >> "$summary"; continue; }
    for age in oldest newest; do
        venv=$work/$(basename "$python")-$age
        "$python" -m venv "$venv"
        case $age in
            oldest) oldest "$python" > "$venv/pins"; deprecated=default ;;
            newest) : > "$venv/pins"; deprecated=error ;;
        esac
        "$venv/bin/python" -m pip install --disable-pip-version-check --quiet --only-binary :all: \
            -c "$venv/pins" "$work"/qsgm-*.whl pytest hypothesis
        versions=$("$venv/bin/python" -c '
import importlib.metadata as m, sys
names = ("onnxruntime", "numpy", "opencv-python-headless", "typer", "rich")
print(sys.version.split()[0], *(f"{name} {m.version(name)}" for name in names), sep=", ")')
        # shellcheck disable=SC2086
        (cd "$work/elsewhere" && QSGM_TEST_BUNDLE=$work/bundle "$venv/bin/python" -m pytest -q \
            -p no:cacheprovider -W $deprecated::DeprecationWarning ${TESTS:-}) > "$venv/log" 2>&1 && status=0 || status=$?
        tried=$((tried + 1))
        [ $status = 0 ] || broken=$((broken + 1))
        echo "$versions: exit code $status, $(tail -n 1 "$venv/log")" | tee -a "$summary"
    done
done
echo
cat "$summary"
[ $tried -gt 0 ] && [ $broken = 0 ]
