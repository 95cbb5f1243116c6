#!/bin/sh
# Train the predecessor's best setting on GSV-XS and measure it on SF-XS and Tokyo-XS. Needs a GPU.
#   GSV_XS=... SF_XS=... TOKYO_XS=... sh lab/benchmarks/reproduce/sf-xs-tokyo-xs.sh
# Interrupted, it is run again: training goes on, rows that are there are not described again.
set -eu

: "${GSV_XS:?folder with train/ and dataframes/}"
: "${SF_XS:?folder of sf_xs}"
: "${TOKYO_XS:?folder of tokyo_xs}"
RUNS=${RUNS:-runs}
RESULTS=${RESULTS:-results}

# Counts and fingerprints first: figures of another set of the same name can't be compared.
for data in "$SF_XS" "$TOKYO_XS"; do
    placewise datasets check "$data"
done

if [ -d "$RUNS/cosplace" ]; then
    placewise train --resume "$RUNS/cosplace"
else
    placewise train --config configs/train-cosplace.yaml \
        --data_root "$GSV_XS" --eval_roots "[\"$SF_XS\", \"$TOKYO_XS\"]" \
        --precision 32 --default_root_dir "$RUNS" --run_name cosplace
fi

# The best epoch by sfxs_val, as the run's own summary names it.
best=$(python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["best"]["path"])' \
    "$RUNS/cosplace/metrics.json")
for size in native same; do
    placewise evaluate --data "$SF_XS" --checkpoint "$best" --image-size $size \
        --out "$RESULTS/cosplace-$size/sf-xs"
    placewise evaluate --data "$TOKYO_XS" --checkpoint "$best" --image-size $size \
        --out "$RESULTS/cosplace-$size/tokyo-xs"
done
