"""Names that first-party distributions provide, for the pip command in a message.

Shipped with the core and never built from user input: suggesting ``pip install fluxvla-<typo>``
would invite typosquatters. A test compares it with the distributions' own pyproject files.
"""

from __future__ import annotations

from collections.abc import Mapping

FIRST_PARTY: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "fluxvla-aloha": {
        "action_filters": ("AlohaWorkspaceBox",),
        "operators": ("AlohaOperator",),
        "runners": ("AlohaInferenceRunner", "AlohaRTCInferenceRunner"),
    },
    "fluxvla-ddp": {"runners": ("DDPTrainRunner",)},
    "fluxvla-deepspeed": {"runners": ("DeepSpeedTrainRunner",)},
    "fluxvla-fsdp": {"runners": ("FSDPTrainRunner",)},
    "fluxvla-gr00t": {
        "checkpoint_formats": ("GR00TN15Format", "GR00TN17Format", "LeRobotGR00TFormat"),
        "heads": ("GR00TActionHead",),
        "transforms": (
            "ClipNormalized",
            "ListInstruction",
            "ProcessQwenPrompts",
            "ResizeCropImages",
        ),
        "vlas": ("GR00T",),
        "vlm_backbones": ("EagleBackbone", "Qwen3VLBackbone"),
    },
    "fluxvla-gymnasium": {"environments": ("GymnasiumEnvironment",)},
    "fluxvla-latency": {"hooks": ("LatencyLog",)},
    "fluxvla-lerobot": {"policies": ("LeRobotPolicy",)},
    "fluxvla-libero": {
        "environments": ("LiberoEnvironment",),
        "policies": ("LiberoExpert",),
        "runners": ("LiberoEvalRunner", "LiberoInferenceRunner"),
    },
    "fluxvla-metaworld": {
        "environments": ("MetaWorldEnvironment",),
        "policies": ("MetaWorldExpert",),
    },
    "fluxvla-models": {
        "checkpoint_formats": ("LeRobotACT", "LeRobotDiffusion"),
        "heads": ("FlowMatchingHead", "LlavaActionHead"),
        "llm_backbones": ("LlamaBackbone", "Qwen2Backbone", "Qwen3Backbone", "SentenceEncoder"),
        "projectors": ("FiLMProjector", "FusedMLPProjector", "LinearProjector"),
        "tokenizers": ("FastTokenizer",),
        "transforms": ("SampleDiffusionNoise", "SampleLatentNoise"),
        "vision_backbones": ("ConvEncoder", "SigLIPBackbone"),
        "vlas": ("ACT", "CompactVLA", "DiffusionPolicy", "LlavaVLA"),
        "vlm_backbones": ("PaliGemmaBackbone",),
    },
    "fluxvla-openvla": {
        "checkpoint_formats": ("OpenVLAFormat",),
        "commands": ("openvla-oft",),
        "transforms": (
            "CenterCropOpenVLAImages",
            "DenormalizeOpenVLA",
            "JitterOpenVLAColors",
            "NormalizeOpenVLA",
            "ProcessOpenVLAPrompts",
            "RandomCropOpenVLAImages",
            "ResizeOpenVLAImages",
            "SampleDiffusionSteps",
        ),
        "vlas": ("OpenVLA", "OpenVLAOFT"),
    },
    "fluxvla-pi": {
        "checkpoint_formats": ("LeRobotPi", "LeRobotPi0Fast", "OpenPi", "TransformersPi0"),
        "transforms": ("ProcessActionTokens",),
        "vlas": ("PI05FlowMatching", "PI0FAST", "PI0FlowMatching"),
    },
    "fluxvla-report": {"commands": ("report",)},
    "fluxvla-rerun": {"hooks": ("RerunViewer",)},
    "fluxvla-sim": {
        "commands": ("collect", "sim"),
        "environments": ("AlohaSimEnvironment", "URSimEnvironment"),
        "operators": (
            "AlohaSimOperator",
            "AlohaSimROSOperator",
            "URSimOperator",
            "URSimROSOperator",
        ),
        "policies": ("SimExpert",),
        "runners": ("AlohaSimEvalRunner", "URSimEvalRunner"),
    },
    "fluxvla-smolvla": {
        "checkpoint_formats": ("LeRobotSmolVLA",),
        "transforms": ("SmolVLAImages", "SmolVLANormalize", "SmolVLAPrompt"),
        "vlas": ("SmolVLA",),
    },
    "fluxvla-ur": {
        "action_filters": ("URWorkspaceBox",),
        "operators": ("UROperator", "URRTDEOperator"),
        "runners": ("URInferenceRunner",),
    },
    "fluxvla-wandb": {"commands": ("wandb",), "hooks": ("WandbVideos",)},
}


def owner(registry: str, name: str) -> str | None:
    """The first-party distribution that provides ``name`` in ``registry``, if one does."""
    for dist, provided in FIRST_PARTY.items():
        if name in provided.get(registry, ()):
            return dist
    return None


def names(registry: str) -> list[str]:
    """Every first-party name of ``registry``, installed or not."""
    return sorted(n for provided in FIRST_PARTY.values() for n in provided.get(registry, ()))
