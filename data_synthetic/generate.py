"""Make the cohort that is committed beside this file; run it again and nothing changes."""

from pathlib import Path

from ssmpipe.synth.femur_distal import write_cohort

if __name__ == "__main__":
    write_cohort(Path(__file__).parent / "femur_distal", n=6, seed=0, spacing=3.0)
