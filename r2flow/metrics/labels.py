"""Agreement of labels, as common classes: intersection over union (IoU) of each class."""

import numpy as np
import torch
from numpy import ndarray
from torchmetrics.functional.classification import multiclass_confusion_matrix

from r2flow.lidar.labels import COMMON


def confusion(truth: ndarray, found: ndarray) -> ndarray:
    """Numbers of labelled points of each true and found class, (K + 1, K + 1); 0 is no label.

    Points without a true label are left out, so row 0 is 0.
    """
    counts = multiclass_confusion_matrix(
        torch.from_numpy(found.astype(np.int64)),
        torch.from_numpy(truth.astype(np.int64)),
        num_classes=len(COMMON) + 1,
        ignore_index=0,
    )
    return counts.numpy()


def class_ious(counts: ndarray) -> ndarray:
    """TP / (TP + FP + FN) of each class of `confusion`, (K,); NaN for one that nothing has."""
    right = counts.diagonal()
    union = counts.sum(0) + counts.sum(1) - right
    return np.where(union > 0, right / np.maximum(union, 1), np.nan)[1:]


def mean_iou(counts: ndarray) -> float:
    """Mean IoU of the classes that the truth has."""
    return float(class_ious(counts)[counts[1:].sum(1) > 0].mean())
