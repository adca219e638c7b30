"""FluxVLA on Universal Robots arms."""
