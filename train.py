"""Train what the command line describes, as `r2flow train` does. With no arguments: the demo,
`experiment=demo`.

    python train.py
    python train.py data=kitti_raw data.root=FOLDER backbone=hdit_small
    python train.py experiment=r2flow_1rf data.root=KITTI-360 trainer=ddp
    python train.py experiment=r2flow_2rf stage.parent=runs/r2flow_1rf trainer=ddp
    python train.py experiment=r2flow data.root=KITTI-360 trainer=ddp
    python train.py -m backbone=hdit_tiny,hdit_small seed=1,2,3
    python train.py --plugin my.module stage=my_stage

The same command again resumes from the run's last checkpoint. `--cfg job` shows every key, `--help`
the choices.
"""

from pathlib import Path

from r2flow.cli import main

if __name__ == "__main__":
    main("train", command=[str(Path(__file__).resolve())])
