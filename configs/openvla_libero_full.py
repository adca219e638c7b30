"""OpenVLA on LIBERO, trained as a whole; see ``openvla_libero.py``.

fluxvla run --config configs/openvla_libero_full.py --section runner --nproc 8

Batches of 256 on 8 GPUs, a constant rate of 2e-5 and clipping at 1: the authors' configuration for
one dataset (prismatic/conf/vla.py, DINO and SigLIP at 224 pixels on BridgeData).
"""

_base_ = "openvla_libero.py"

train_dataloader = dict(per_device_batch_size=32)

runner = dict(
    type="FSDPTrainRunner",
    learning_rate=2e-5,
    weight_decay=0.0,
    max_grad_norm=1.0,
    lora=None,
)
