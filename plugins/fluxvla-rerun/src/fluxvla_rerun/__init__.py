"""FluxVLA runs in the Rerun viewer (https://rerun.io), live and as ``.rrd`` files."""
