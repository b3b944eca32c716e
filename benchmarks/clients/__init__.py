"""Assets opened in other programs as they are imported, nothing touched, and rendered as the capturing camera sees them.

    python -m benchmarks.clients render blender owl.usdz --capture samples/owl --environment samples/owl/environment.exr --out owl.exr
    python -m benchmarks.clients compare owl.exr samples/owl/reference_environment.exr --capture samples/owl [--truth truth.exr]
    python -m benchmarks.clients parts DIR [--maps DIR]

`render` opens an asset (.usdz, .usda, .usdc; in blender and three also .glb) in `blender` (Cycles), `three` (three.js in headless Chromium:
USDLoader or GLTFLoader) or `mitsuba` (its `principled` BSDF, textures as OpenUSD reads them) and writes linear RGBA as float EXR, not
denoised, with a box filter of one pixel. The light is an environment (`--environment`, see docs/relight.md for its orientation) or one
distant light (`--sun x,y,z`, irradiance `--irradiance`, default π). `compare` prints the figures of `benchmarks.clients.comparison`.
`parts` measures captures of samples/make_parts.py: docs/asset_viewers.md has its table.

A render needs no GPU; at 128 x 128 pixels it takes 5 to 30 seconds on two cores. `benchmarks.clients.installed` says where the programs are
looked for; `make clients` installs them. From Python:

    from benchmarks.clients.render import Client, Environment, Sun, render
    image = render(Client.BLENDER, asset, camera, Environment(latlong), samples=64)   # [rows, cols, 4] float32, alpha last, premultiplied
"""
