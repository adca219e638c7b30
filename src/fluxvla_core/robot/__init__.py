"""Policies on robots: episodes, their safety, and recordings of what happened.

``runner`` runs tasks as episodes (``engine``, ``episode``); in one, ``control_loop`` commands the
arm, ``observations`` reads the robot and ``inference`` queries the policy. On a robot the former
runs in a process of its own (``process``); ``recording`` writes episodes to files and reads them
back.
"""
