"""Pictures and dives with known truth, for users without hardware and for every accuracy claim.

`scenarios.load_scenario` gives a scenario by name or from a YAML file, `dive.simulate_dive` writes
its video and truth, `render.Renderer` renders single scenes, `random_scenes.random_scene` makes
them for statistics, and `example_rigs` holds rigs to do it with.
"""
