#!/bin/sh
# One lesson on 64-bit Arm, emulated, beside the same here: what differs. `benchmarks/arm64.sh FOLDER
# [EPOCHS]` on Debian 12 x86-64; nothing is installed. Debian's Python for Arm runs in qemu, with the
# wheels that a board gets, and the same versions on both sides. ONNX Runtime 1.24.1, since 1.32.0 ends
# in qemu 7.2 while it is imported.
set -eu

here=$(cd "$(dirname "$0")/.." && pwd)
python=${HOST_PYTHON:-$here/.venv-test/bin/python}
work=$1
epochs=${2:-3}
mkdir -p "$work/lists/partial" "$work/cache/archives/partial" "$work/debs" "$work/host" "$work/wheels"
cd "$work"
work=$(pwd)

(cd host && apt-get download qemu-user-static && dpkg -x qemu-user-static*.deb .)
arm() {
    apt-get -oAPT::Architecture=arm64 -oAPT::Architectures=arm64 -oDir::State::status=/dev/null \
        -oDir::State::Lists="$work/lists" -oDir::Cache="$work/cache" "$@"
}
arm update
(cd debs && arm download libc6 libgcc-s1 libstdc++6 gcc-12-base zlib1g libexpat1 libssl3 libffi8 \
    libbz2-1.0 liblzma5 libuuid1 libcrypt1 python3.11-minimal libpython3.11-minimal \
    libpython3.11-stdlib python3.11)
for deb in debs/*.deb; do dpkg -x "$deb" root; done
for package in numpy==2.4.6 onnxruntime==1.24.1 opencv-python-headless==5.0.0.93 typer==0.28.0 rich \
    click markdown-it-py mdurl pygments shellingham flatbuffers protobuf packaging \
    typing_extensions annotated-doc; do
    "$python" -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.11 \
        --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 \
        --platform manylinux2014_aarch64 --platform any -d wheels "$package"
done
for wheel in wheels/*.whl; do "$python" -m zipfile -e "$wheel" site; done

"$python" -m venv same
same/bin/python -m pip install --disable-pip-version-check --quiet numpy==2.4.6 onnxruntime==1.24.1 \
    opencv-python-headless==5.0.0.93 typer==0.28.0 rich

lesson=$here/benchmarks/one_lesson.py
PYTHONPATH=$here same/bin/python "$lesson" here.npz "$epochs"
PYTHONPATH=$work/site:$here host/usr/bin/qemu-aarch64-static -L root \
    root/usr/bin/python3.11 "$lesson" arm.npz "$epochs"
PYTHONPATH=$here "$python" "$lesson" here.npz arm.npz
