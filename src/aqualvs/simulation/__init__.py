"""Simulated pictures and dives with known truth: for users without hardware, for accuracy claims.

`scenarios.load_scenario` gives a scenario by name or from a YAML file, `dive.simulate_dive` writes
its video and truth, `render.Renderer` renders single scenes, and `scenarios.example_rig` and
`bluerov2_rig` are rigs to do it with.
"""
