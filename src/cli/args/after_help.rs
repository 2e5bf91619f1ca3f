//! What the help of each command says after its options.
//!
//! Lines are at most 80 columns wide, so that a narrow terminal does not wrap them again.

pub(super) const CHOOSING: &str = "\
Choosing the spacing, the voxel size and how far particles blend:
  The particle spacing d, twice the particle radius of the simulation, is the
  only number you may need: --spacing. Without it, d is measured on the first,
  middle and last frame of the sequence, printed, and the same for every frame.

  A LENGTH is a number in world units, the particles' unit of length; or in
  particle spacings, such as 0.6d; or in voxels, such as 5h. Exceptions:
  --spacing has no other unit than the world unit, and --voxel-size cannot be in
  voxels.

  By default, lengths and the amount (pseudo-time) of smoothing scale with d.
  The voxel size h is 0.32d: half that size shows more detail of the same
  surface, and takes about eight times the time and four times the memory. On a
  coarse grid particles are larger, so that none falls between the voxels.

  The surface encloses the (smoothed) position of every particle.

  --blend         distance up to which particles blend with others. More is
                  smoother and joins drops earlier; less follows the particles
                  more closely.
  --max-stretch   how far particles are flattened in sheets and filaments. More
                  makes them thinner.
  --laplacian-steps
                  how much the surface is smoothed.
  --position-smoothing
                  how far particles are first moved towards the mean of their
                  neighbours. More makes the surface smoother and steadier; 0
                  keeps every original position inside the surface.

  With --preset paper the surface encloses a sphere of radius r_min around every
  particle, each of its points is within r_max of some particle, and these radii
  follow h, as in the paper. If h is smaller than half the spacing, neighbouring
  spheres would not overlap: also give r_min, in spacings, for example
  --voxel-size 0.25d --radius-min 0.866d.

Exit status:
  0    every frame was converted, or was done already
  1    some frames failed, or their results failed validation; each is named,
       with the reason, and the others are complete
  2    the command is invalid, or no frame was converted, or the standard output
       cannot be written
  75   the machine failed, its disk or a folder that it shares: run it again
  130  interrupted: existing results are complete, and --skip-done continues
       from there";

pub(super) const WATCHING: &str = "\
When a frame is read:
  A file is read as soon as one of these is true:
  - it was renamed into place
  - its sentinel exists
  - its format shows that it is complete, and it has not changed for --settle
  - its format cannot show this, and it has not changed for 4 times --settle
  A file that is written again later is converted again. Inputs are never moved,
  changed or removed.

  Records in the folder for the results say which frames are finished, so a
  restarted daemon resumes where it left off. `meniscus status --out DIR` prints
  them, and `meniscus status FRAME --out DIR` what is recorded of one frame.

Lengths:
  `meniscus convert --help` explains LENGTH, d (particle spacing) and h (voxel
  size).

Signals:
  SIGTERM, SIGINT  finish the frames in flight within 30s, and exit; a second
                   one exits at once. Neither leaves partial files. On Windows
                   Ctrl-C is SIGINT, and a closed console a second signal

Exit status:
  0    with --once: every frame is converted. Without: the daemon stopped on
       request
  1    with --once: some frames failed, were not converted (for example because
       their sentinel is missing), or failed validation; or the stage or the
       records could not be written. Each is named, with the reason
  2    the command is invalid; with --once also: no frame was converted
  130  stopped at once by a second SIGINT; 143 by a second SIGTERM";

pub(super) const CAMERAS: &str = "\
Cameras:
  By default a fixed camera shows the whole sequence, according to the bounds of
  its first, middle and last frame. Keys are separated by commas:
    azimuth, elevation  degrees from the front to the right, and above the
                        horizon [default: 32, 22]
    zoom                1 fits the bounds, 2 shows them twice as large
                        [default: 1]
    view                vertical angle of view, in degrees [default: 30]
    up                  axis of the world that points up, y or z
                        [default: that of --up]
    ground              height of the ground, or none
                        [default: the lowest point of the bounds]
  or, instead of the first three:
    eye, target         position of the camera, and the point that it looks at,
                        such as 1:2:3
    top                 direction that points up in the picture, such as 0:1:0
                        [default: that of up]

Layers of a multi-part .exr, one part each:
  beauty     R G B A      linear, 16 bits; A is 1, because the ground is in
                          the picture
  coverage   Y            the part of the pixel that the surface covers, 16 bits
  depth      Z            along the camera's axis, world units; 1e10 where no
                          surface is visible
  normals    N.X N.Y N.Z  outward, in world space, 16 bits
  position   P.X P.Y P.Z  world units
  velocity   V.X V.Y V.Z  world units per second, if the particles have it
  curvature  Y            mean curvature, per world unit; positive where the
                          fluid bulges

Exit status:
  0    every picture was written
  1    some frames failed; each is named, with the reason
  2    the command is invalid, or no picture was written";

pub(super) const TUNING: &str = "\
What is shown:
  A close-up of the part of the frame with the most surface, 16 particle
  spacings wide; with --camera zoom=1 the whole frame. --camera and
  --camera-from select any other view.

  All other options apply to every cell; without --vary, an option that is given
  is not varied. For each cell, the command that converts INPUT with its
  settings is on the sheet, and is printed with the time that the cell took.

Exit status:
  0    every cell has its picture
  1    some settings were refused or failed: their cells have the reasons, and
       the others are shown
  2    the command is invalid, or no cell has a picture: no sheet was written";

pub(super) const CONTACT_SHEETS: &str = "\
What is shown:
  Each sequence has its own part of the sheet and one camera; files outside
  sequences share a part. Existing pictures are cheapest, then level sets,
  meshes and particles. Pictures are used only if they show all existing frames
  with one camera, and none of --camera, --camera-from and --up is given. The
  title says which kind was used.

Exit status:
  0    every frame is on the sheet
  1    some frames failed: their cells have the reasons, and the others are
       shown
  2    the command is invalid, or no frame could be shown: no sheet was written";

pub(super) const DEFINITION: &str = "\
What is scored:
  Points on the surface of a frame, evenly by area, are advected to the frames
  before and after it with the particles around them. These are followed by
  their ids if at least half of those in the first frame have unique ones, else
  by their velocities. A point's flicker is the second difference of its signed
  distances to the three surfaces, in particle spacings. The score is the root
  of its mean square: 0 for a surface that moves as its particles do. The first
  difference is the root mean square of the distances to the next surface, and
  lag 2 that of points carried from the frame before to the frame after. A ghost
  is a piece of the surface without particles, or with less than half of their
  volume. The volume step is the largest change of the volume from a frame to
  the next, relative to the volume.

  A distance of more than 2 spacings counts as 2. Points with no particle within
  3 spacings are counted and left out. A frame is scored if the frames before
  and after it have a mesh and particles.

Exit status:
  0    every frame between two others is scored
  1    some frames could not be read, so they and their neighbours are not
       scored
  2    the command is invalid, or no frame is scored";

pub(super) const PLAYING: &str = "\
The number of a frame determines when it is shown; if a frame is missing, the
previous frame is held. In an .abc frame n is at n / --fps seconds. In a .glb
the differences between the numbers are divided by their greatest common
divisor: frames 0, 100 and 300 play at frames 0, 1 and 3. If some names have no
number, or the numbers do not increase, frames are counted from 1.

The file may replace an older sequence file, and no other file.

Frame n of a scene shows frame n of the .glb if the scene has the same frames
per second as --fps: in Blender set the frame rate (24 by default) before
importing. At a lower rate the scene skips frames.

A .glb has a node for each frame, and shows one after the other by animating
their scales in steps; it must stay below 4 GiB. An .abc has no such limit: it
is one mesh with time samples. Do not blend between the samples: vertices with
the same index in two frames are different points of the surface.

All frames are read as .glb; those in .abc or .usdc are converted in memory,
which takes two to four times the size of the file. So a frame must stay below 4
GiB as .glb, and the sequence file has what a .glb has: integers are floats,
without those beyond 2^24, and there are no quads and no strings.

An .abc also has the points of --spray beside the frames, from files such as
dam.0012.spray.usdc: as surface_spray, with all their attributes. A .glb has
only meshes.

Exit status:
  0    all frames are in the sequence file
  1    some frames, or their points, could not be read, and are left out; each
       is named, with the reason
  2    no sequence file was written";

pub(super) const VERIFY_STATUSES: &str = "\
State of a frame:
  done        the results have the bytes that were written, were made from the
              current input with the settings of most frames of the sequence,
              and passed validation
  missing     a result does not exist, or there is no record of the frame
  damaged     a result was changed or replaced after it was written
  stale       made from another version of the input, or of a frame averaged
              with it; or made with other settings, or by another version of
              meniscus
  violations  as done, but a check of the surface failed: converting again would
              give the same result

Exit status:
  0    every frame is done
  1    some frames are not done
  2    no frame is done, or the command is invalid";

pub(super) const STATUS_JSON: &str = "\
Exit status:
  0    no frame has failed; with FRAME: it has not failed
  1    some frames have failed; with --config also: a folder cannot be read
  2    nothing is recorded in the folder; with FRAME: nothing is recorded of it

JSON: an object with the following; with --config a list of such objects; with
FRAME a frame
  output           the folder
  daemon           null if none is known, or an object with
                     running         true or false; null if the file system has
                                     no locks
                     held_by         the process that holds the folder now
                     state           running, paused, starting, stopped, killed
                     paused_because  the reason, if it is paused
                     pid, host, started_ms, at_ms
                                     of the last daemon; at_ms: when it entered
                                     this state
  counts           the numbers of frames that are done, queued, retrying,
                   waiting, failed
  spacings         the particle spacings that were measured: sequence, spacing,
                   and measured_on, the number of frames
  failed, retrying, waiting, last_done, flawed
                   frames, each with input, state, outputs, attempts, settings
                   and at_ms, and if they are known reason, particles, seconds
                   and flaws. waiting: files that are not yet complete;
                   last_done: the newest first, five at most; flawed: those
                   converted without some particles, or that failed validation.
                   state: waiting, queued, done, retrying, failed, refused
                   (because of other files), given_up (until the file changes or
                   the daemon restarts), ignored (not a frame). settings: equal
                   for frames that were converted with the same settings
Times that end in _ms are milliseconds since 1970.";

pub(super) const WHERE_COMPLETIONS_GO: &str = "\
Where it goes, for one user:
  bash  meniscus completions bash \\
          > ~/.local/share/bash-completion/completions/meniscus
  zsh   meniscus completions zsh > ~/.zfunc/_meniscus
        and in ~/.zshrc, before compinit: fpath+=~/.zfunc
  fish  meniscus completions fish > ~/.config/fish/completions/meniscus.fish
The Debian package has these three in place.";

pub(super) const WHERE_PAGES_GO: &str = "\
Where they go, for one user:
  meniscus man --out ~/.local/share/man/man1
The Debian package has them in place.";
