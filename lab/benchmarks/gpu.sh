#!/usr/bin/env bash
# Measures extraction on a GPU, and search on the processors beside it. Ten minutes at most.
#
#   lab/benchmarks/gpu.sh [FOLDER]        results: FOLDER/gpu.md and a JSON file for each measurement
#
# Run it in a checkout after `make setup`. Random weights of the true shape are used where no others
# are installed: the speed does not depend on their values. A measurement that fails, or that the
# time is too short for, is named in the table. Every setting below may be overridden.
set -u
folder=${1:-gpu-results}
device=${DEVICE:-cuda}
seconds=${SECONDS_IN_ALL:-570}
extractors=${EXTRACTORS:-"anyloc-vitg14 anyloc-vitg14:preprocessing=paper480x640"}
precisions=${PRECISIONS:-"bfloat16 float32"}
batches=${BATCHES:-64,1,16,256}
photos=${PHOTOS:-256}
rounds=${ROUNDS:-1}
search=${SEARCH:-"--photos 20000 --dimensions 512,4096"}
placewise=${PLACEWISE:-.venv/bin/placewise}
python=${PYTHON:-.venv/bin/python}

mkdir -p "$folder"
rm -f "$folder"/*.json "$folder"/*.err

# NAME ARGUMENTS...: one `placewise bench`, with the time that is left.
measure() {
    local name=$1 left=$((seconds - SECONDS))
    shift
    if [ "$left" -le 5 ]; then
        echo "no time was left" >"$folder/$name.err"
        return
    fi
    echo "$name ($left s left)" >&2
    if ! timeout "$left" "$placewise" bench "$@" --json >"$folder/$name.json" 2>"$folder/$name.err"; then
        # A missed target exits with 1, too, and leaves its result.
        [ -s "$folder/$name.json" ] || { rm -f "$folder/$name.json"; return; }
    fi
    rm -f "$folder/$name.err"
}

number=0
for extractor in $extractors; do
    for precision in $precisions; do
        number=$((number + 1))
        measure "$number-extract-$precision" extract --extractor "$extractor" --device "$device" \
            --precision "$precision" --batch "$batches" --photos "$photos" --rounds "$rounds"
    done
done
# shellcheck disable=SC2086  # a list of options
measure 90-search search $search
"$python" -m lab.benchmarks.report "$folder" >"$folder/gpu.md"
cat "$folder/gpu.md"
