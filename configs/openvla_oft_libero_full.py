"""OpenVLA-OFT on LIBERO, trained as a whole; see ``openvla_oft_libero.py``.

fluxvla run --config configs/openvla_oft_libero_full.py --section runner --nproc 8

The authors train adapters. Rate and clipping are those of OpenVLA's full fine-tuning
(prismatic/conf/vla.py), batch, length and its schedule's shape those of OpenVLA-OFT.
"""

_base_ = "openvla_oft_libero.py"

runner = dict(
    type="FSDPTrainRunner",
    learning_rate=2e-5,
    lr_schedule={"_delete_": True, "0": 2e-5, "0.6666667": 2e-6},
    weight_decay=0.0,
    max_grad_norm=1.0,
    lora=None,
)
