"""The names of the environments in gymnasium: `corotate/rigid-pair-v0` and so on. Must not import gymnasium: few need it."""

import importlib.abc
import importlib.util
import sys

# The scenarios that ship and can be stepped: with a controller, and of single bodies.
SCENARIOS = ("rigid-pair", "rigid-pair-hyperbolic", "rigid-trio", "noisy-pair", "mismatched-follower", "gyro-loss", "recorded-leader",
             "faults", "orbit-hold", "orbit-rendezvous")


def register():
    """Registers the environments."""
    from gymnasium.envs.registration import register as add
    for name in SCENARIOS:
        add(id=f"corotate/{name}-v0", entry_point="corotate.env:Env", kwargs={"scenario": name})


def register_with_gymnasium():
    """Registers the environments, at once or when gymnasium is imported: it no longer looks for them by itself."""
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _WhenImported) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WhenImported())


class _WhenImported(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module):
                execute(module)
                register()

            spec.loader.exec_module = execute_and_register
        return spec
