"""SmolVLA on LIBERO-Object, trained as a whole; see ``smolvla_libero.py``.

fluxvla run --config configs/smolvla_libero_full.py --section runner --nproc 2

LeRobot's ``train_expert_only=false`` and ``freeze_vision_encoder=false``, with the numbers of the
paper (arXiv 2506.01844), which itself trains the expert alone.
"""

_base_ = "smolvla_libero.py"

model = dict(freeze_vision_encoder=False, train_expert_only=False)

runner = dict(enable_gradient_checkpointing=True)
