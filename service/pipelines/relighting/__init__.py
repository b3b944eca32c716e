"""Relighting in the order of its steps: frames (which, where), keys and schedule (what lights each), environments, weights, combine
(linear frames), layers, write, sheet. `service.pipelines.relight` runs them.
"""
