#!/bin/bash
# An array of jobs that train the scenes of scenes.txt, a path a line, under runs/all. First:
# cargo build --release -p xtask
#SBATCH --array=1-100
#SBATCH --cpus-per-task=4
#SBATCH --mem=4G
#SBATCH --time=02:00:00
#SBATCH --requeue
#SBATCH --signal=TERM@60
srun target/release/xtask train --list scenes.txt --out runs/all --shard slurm --threads 4
