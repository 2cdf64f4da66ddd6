"""A real viewer looks: Foxglove Studio 1.48 (its last open release) in a headless Chromium. Not part of the suite.

    npm install --ignore-scripts @foxglove/studio-base@1.48.0 react@17.0.2 react-dom@17.0.2
    apt-get install chromium && pip install playwright
    python -m tests.studio node_modules PICTURES

Studio 1.48 says ``foxglove.websocket.v1`` where today's Foxglove says ``foxglove.sdk.v1``: the name is replaced.
"""
