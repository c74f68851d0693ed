"""Generators on the Hugging Face Hub, as `.safetensors`; needs the extra `hub`.

HubFlow("runs/NAME").push_to_hub("me/my-flow")
scans = HubFlow.from_pretrained("me/my-flow").sample(4)
"""

from pathlib import Path
from typing import Any

from torch import Tensor

from r2flow import load
from r2flow.errors import require
from r2flow.model.checkpoint import save_checkpoint

require("r2flow.model.hub", "hub", "huggingface_hub")

from huggingface_hub import ModelHubMixin, hf_hub_download  # noqa: E402

FILE = "model.safetensors"
CARD = """---
{{ card_data }}
---

A generator of LiDAR scans, made with r2flow.

```python
from r2flow.model.hub import HubFlow

scans = HubFlow.from_pretrained("{{ repo_id | default('FOLDER', true) }}").sample(4)  # range in metres and reflectance
```
"""


class HubFlow(  # type: ignore[call-arg, unused-ignore]  # if the extra is not installed
    ModelHubMixin, library_name="r2flow", tags=["lidar", "rectified-flow"], model_card_template=CARD
):
    """A trained generator with `save_pretrained(folder)`, `from_pretrained(folder or name)`, `push_to_hub(name)`.

    Args:
        name, device: As for `r2flow.load`.

    Attributes:
        checkpoint: The checkpoint that `r2flow.load` returns.
    """

    def __init__(self, name: str | Path, device: str = "cpu") -> None:
        self.checkpoint = load(name, device)
        self._hub_mixin_config = None  # it would be `name`; the weights' file has the config

    def sample(self, num: int = 1, seed: int = 0, **how: Any) -> Tensor:
        """As `Checkpoint.sample`."""
        return self.checkpoint.sample(num, seed, **how)

    def _save_pretrained(self, save_directory: Path) -> None:
        save_checkpoint(self.checkpoint, save_directory / FILE)

    @classmethod
    def _from_pretrained(  # type: ignore[override, unused-ignore]
        cls, *, model_id: str, device: str = "cpu", revision: Any, cache_dir: Any, force_download: bool,
        local_files_only: bool, token: Any, proxies: Any = None, resume_download: Any = None,
    ) -> "HubFlow":  # fmt: skip
        where = {"revision": revision, "cache_dir": cache_dir, "force_download": force_download, "token": token}
        local = Path(model_id, FILE) if Path(model_id).is_dir() else None
        return cls(local or hf_hub_download(model_id, FILE, local_files_only=local_files_only, **where), device)
