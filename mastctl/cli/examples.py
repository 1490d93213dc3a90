"""One example of each command, as its --help shows it."""

from __future__ import annotations

from collections.abc import Mapping

_ALL = """
run --config rover.yaml
status --json
point --camera navcam_left --at 300 420
snapshot navcam_left --out left.png
stop
estop --name Ana --reason "sparks at the mast"
reset --name Ana --reason "cable mended"
halt --config rover.yaml
lease show
lease take --for 60
lease renew --lease 0f3c --for 60
lease release --lease 0f3c
token new --name wall --role view
token list
token revoke wall
track start --camera navcam_left --at 300 420
track status
track watch --count 10
track pose --position 4.1 0.2 0 --sigma 0.02 0.009
track look
track stop
jog --rates 0.2 0 --seconds 2
operations list
operations show 000012-9f3a
operations watch 000012-9f3a
mast show --out now.yaml
mast use rocky8-refined.yaml
mast back
reload
fault list
fault set navcam_left dark for_s=5
fault clear navcam_left
events state fault --count 5
camera project mast.yaml --camera navcam_left --pan 0.3 --tilt -0.2 --points points.csv
camera ray mast.yaml --camera navcam_left --pan 0.3 --tilt -0.2 --pixels pixels.csv
camera convert camera.yaml camera.cahvor
camera maps mast.yaml --pair navcam --out maps.npz
camera list
camera sync navcam_left navcam_right --config rover.yaml
camera check /dev/video0 --rate 30
camera grab /dev/video0 --out picture.png
camera focus /dev/video0 --seconds 30
solve mast.yaml --camera navcam_left --target 6 1 0
triangulate mast.yaml --pair navcam --pan 0.3 --tilt -0.2 --left 300 420 --right 271 420
budget
handoff mast.yaml --from navcam --to hazcam --pan 0.3 --tilt -0.2 --left 300 420 --right 271 420
board make --kind charuco --paper A4 --out board.pdf
board measured board.yaml --across-mm 149.6 --down-mm 149.8
board find board.yaml picture.png
calibrate survey --out mast.yaml --report report
calibrate bench --config rig.yaml --board board.yaml --out mast.yaml --report report
experiment pointing --targets 20 --out pointing
demo --out demo
completion bash
conform http://127.0.0.1:8420
doctor --config rover.yaml
sentinel reference --folder sentinel --rest 0,-0.3
sentinel look --folder sentinel
sentinel watch --folder sentinel --every-s 86400
sentinel status --folder sentinel
record start afternoon
record stop
record list
record show afternoon.mcap
record repair broken.mcap --out whole.mcap
replay afternoon.mcap --mast other.yaml
sim new twin --height 1.9 --baseline 0.42
sim dynamixel --servo xl330_m288:1 --servo xl330_m288:2 --pty
sim ptu --pty
servo scan /dev/ttyUSB0
servo info /dev/ttyUSB0 1
servo set-id /dev/ttyUSB0 1 2
servo test /dev/ttyUSB0 1 --degrees 5
ptu info /dev/ttyUSB0
ptu home /dev/ttyUSB0
"""
_GROUPS = frozenset(
    (
        *("lease", "token", "track", "operations", "mast", "fault", "camera", "experiment", "record"),
        *("sim", "servo", "ptu", "board", "sentinel"),
    )
)


def _command_of(line: str) -> str:
    words = line.split()
    two = words[0] in _GROUPS or words[:2] == ["calibrate", "bench"]
    return " ".join(words[:2] if two else words[:1])


EXAMPLES: Mapping[str, str] = {
    f"mastctl {_command_of(line)}": f"mastctl {line}" for line in _ALL.strip().splitlines()
}
"""Of a command, ``mastctl lease take``, a line that a shell would take."""
