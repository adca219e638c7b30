"""Datasets: LeRobot v3.0 written, merged and read; batches in an order that can be resumed."""
