"""Simulated ALOHA and UR5e robots on MuJoCo, their experts, their operators, their evaluation."""
