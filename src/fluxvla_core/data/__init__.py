"""Datasets, transforms, collators and tokenizers: from files to batches.

What ``__all__`` lists may be imported by anybody; the modules of this package are private. Each
name is imported when it is first used, so that importing this package loads no torch.

==============================  ==================================================================
``ParquetDataset``              training samples from LeRobot datasets
``DistributedRepeatingDataset`` a weighted mixture of datasets
``PrivateInferenceDataset``     a robot's observation as a model's batch of one
``SampleKey``                   epoch and index, what ``get_samples`` of a dataset is given
``sample_rng``                  the random number generator of one sample, for datasets
``Pipeline``                    a list of transforms, as a config names them
``split_images``                images of a sample as one array a camera, for transforms
``stack_images``                images of a sample as one array, for transforms
``DictCollator``                samples to a batch
``PretrainedTokenizer``         the tokenizer of a pretrained model
``model_folder``                a pretrained model's folder, checked for ``from_pretrained``
``resolve_model_path``          a pretrained model's folder, in the file system or in a package
``LeRobotWriter``               records a LeRobot v3.0 dataset
``make_affine``                 offset and scale of states or actions by an entry of the statistics
``merge_datasets``              merges what several ``LeRobotWriter`` recorded
==============================  ==================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.data.assemble import merge_datasets as merge_datasets
    from fluxvla_core.data.dataset import ParquetDataset as ParquetDataset
    from fluxvla_core.data.inference_dataset import (
        PrivateInferenceDataset as PrivateInferenceDataset,
    )
    from fluxvla_core.data.loader import DictCollator as DictCollator
    from fluxvla_core.data.mixture import DistributedRepeatingDataset as DistributedRepeatingDataset
    from fluxvla_core.data.pretrained import PretrainedTokenizer as PretrainedTokenizer
    from fluxvla_core.data.pretrained import model_folder as model_folder
    from fluxvla_core.data.pretrained import resolve_model_path as resolve_model_path
    from fluxvla_core.data.sampler import SampleKey as SampleKey
    from fluxvla_core.data.sampler import sample_rng as sample_rng
    from fluxvla_core.data.statistics import make_affine as make_affine
    from fluxvla_core.data.transforms.images import split_images as split_images
    from fluxvla_core.data.transforms.images import stack_images as stack_images
    from fluxvla_core.data.transforms.pipeline import Pipeline as Pipeline
    from fluxvla_core.data.writer import LeRobotWriter as LeRobotWriter

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
