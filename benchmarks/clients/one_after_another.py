"""Runs the `main` of a script for one job after another; runs in a Python that has nothing of relit.

    python one_after_another.py inside_blender.py

Each line on its input is the path of a job. After a job it writes a line that says whether it was done, below what the program said.
"""

import runpy
import sys
import traceback

main = runpy.run_path(sys.argv[1])["main"]
for line in sys.stdin:
    try:
        main(line.rstrip("\n"))
        said = "DONE"
    except Exception:  # of any kind: whoever asked raises it, with what is printed here
        traceback.print_exc()
        said = "FAILED"
    sys.stderr.flush()
    print(f"\njob: {said}", flush=True)
