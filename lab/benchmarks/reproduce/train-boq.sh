#!/bin/sh
# Train EfficientNet-Lite0 with BoQ on generated streets, and compare it with the default extractor on other
# streets, for three seeds. Two CPU cores: about 20 minutes of training for each seed, and as much for the rest.
#   sh lab/benchmarks/reproduce/train-boq.sh
# Interrupted, it is run again: training goes on, rows that are there are not described again.
set -eu

RUNS=${RUNS:-runs/boq}
for seed in ${SEEDS:-1 2 3}; do
    places="$RUNS/places-$seed"
    trained="$RUNS/seed-$seed"
    [ -f "$places/city.json" ] ||
        placewise datasets synth "$places" --places 500 --queries 450 --seed "$seed"
    if [ -f "$trained/checkpoints/last.ckpt" ]; then
        placewise train --resume "$trained"
    else
        placewise train --config configs/train-boq.yaml --data_root "$places" --seed "$seed" \
            --default_root_dir "$RUNS" --run_name "seed-$seed"
    fi
    placewise compare "$places" --out "$RUNS/compared-$seed" \
        --extractors "efficientnet-lite0-vlad128,efficientnet-lite0-vlad128+fit,$trained/checkpoints/last.ckpt"
    # Real photos that it was not trained for, whichever way it goes.
    [ -z "${TOWER:-}" ] || placewise compare "$TOWER" --out "$RUNS/tower-$seed" \
        --extractors "efficientnet-lite0-vlad128,efficientnet-lite0-vlad128+fit,$trained/checkpoints/last.ckpt"
done
