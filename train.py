"""Train what the command line describes, as `r2flow train` does. With no arguments: the demo, `experiment=demo`.

    python train.py
    python train.py data=kitti_raw data.root=FOLDER backbone=hdit_small
    python train.py experiment=r2flow_1rf data.root=KITTI-360 trainer=ddp
    python train.py experiment=r2flow_2rf stage.init=runs/r2flow_1rf trainer=ddp
    python train.py experiment=r2flow data.root=KITTI-360 trainer=ddp
    python train.py -m backbone=hdit_tiny,hdit_small seed=1,2,3
    python train.py --plugin my.module stage=my_stage

The same command again resumes from the run's last checkpoint. `--cfg job` shows every key, `--help` the choices.
"""

import sys
from pathlib import Path

from r2flow.memory import prepare_process
from r2flow.signals import heard_from_the_first_import

if __name__ == "__main__":
    prepare_process()
    with heard_from_the_first_import():
        from r2flow.runs.launch import main

        sys.exit(main(sys.argv[1:], [sys.executable, str(Path(__file__).resolve())]))
