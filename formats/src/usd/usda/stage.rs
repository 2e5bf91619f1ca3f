//! Writes a stage: a small file that plays the files of the frames.
//!
//! ```text
//!   def Xform "root"
//!       over "surface"               the manifest: the attributes that have time samples, without values
//!       def Xform "dam"              a sequence: references the file of one frame, for the definitions
//!           over "surface"           clips: times ──▶ files
//!       def Xform "dam_spray"        the same for the points beside the surface, in `over "spray"`
//!           def Volume "volume"      OpenVDBAsset prims: times ──▶ files
//! ```
//!
//! The meshes are **value clips**: at each time, all values come from the file of one frame. Among the
//! mechanisms of USD this is the one with which a mesh is a single prim with time samples. So Blender, Houdini and usdview play it, blur it by its velocities, and open only the files of the
//! times that they show. A payload for each frame would need a prim for each frame, all of them loaded, and
//! visibilities that Blender does not animate.
//!
//! The clips are listed one by one, instead of by a template such as `dam.####.usdc`. A template finds files
//! when a stage is opened, so it needs no list. But it fits only names with one number, which is the time;
//! and to learn which frames exist, every program that opens the stage looks for all of them. The list holds
//! exactly the frames that are complete, and the writer replaces it when there are more.
//!
//! The file of a frame has one sample, at time code 0, whatever its number. `times` maps all times to it. USD
//! interpolates between values of the same size in consecutive clips, so each frame is repeated just before
//! the next one.
//!
//! The definitions of the attributes are those of the file of one frame, so primvars keep their types and
//! interpolation. Only `xformOpOrder` is here, because its value cannot depend on the time.
//!
//! The manifest of the clips is the stage itself. It declares attributes without values, because where a
//! file lacks an attribute, USD shows the value in the manifest: with the file of a frame as the manifest,
//! other frames would have the velocities of that frame. Without a value, the attribute has none there.
//! USD looks up attributes in the manifest as in a clip, below `primPath`, so one list serves all sequences.

use std::collections::HashSet;

use crate::core::data::Provenance;
use crate::core::error::{Error, Position, Result};
use crate::core::options::UpAxis;
use crate::core::sequence::{check_numbers, held_times};

use crate::core::vertex_attributes::UsedNames;
use crate::usd::{FORMAT, POINTS_PRIM, PRIM, ROOT, SAMPLE_CODE, SampledProperty, TRANSLATE, identifier};

use super::head::{LAST_LINE, head, times};

/// The sequences of a stage, and its units.
#[derive(Clone, Debug, PartialEq)]
pub struct UsdStage {
    /// The path of the stage itself, relative to its folder, such as `./shot.usda`.
    pub path: String,
    /// Which axis of the frames points up.
    pub up: UpAxis,
    /// The length of a world unit in metres.
    pub meters_per_unit: f64,
    /// Frames per second.
    pub fps: f64,
    /// The sequences. Those without files have no prim yet, but take its name, so that the others keep theirs
    /// when files arrive.
    pub sequences: Vec<StageClips>,
}

/// The frames of a sequence: its surfaces, or the points beside them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageClips {
    /// Its name, from which that of its prim is made.
    pub name: String,
    /// Whether `meshes` are points beside surfaces.
    pub are_points: bool,
    /// The meshes or points in USD, in the order of their time codes.
    pub meshes: Vec<ClipFile>,
    /// The index of the file that defines the attributes of all.
    pub declared_by: usize,
    /// The attributes that have time samples in that file.
    pub properties: Vec<SampledProperty>,
    /// The level sets in OpenVDB, in the order of their time codes.
    pub volumes: Vec<ClipFile>,
    /// Whether the level sets have a grid of velocities.
    pub has_velocity: bool,
}

/// A file of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClipFile {
    /// When it is shown.
    pub code: i64,
    /// Its path, relative to the folder of the stage or absolute, with `/` between names.
    pub path: String,
}

/// The text of a stage.
///
/// # Errors
///
/// [`Error::Invalid`] if there is no file, time codes do not increase, or a path has control characters;
/// [`Error::Unsupported`] for time codes beyond 2⁵³.
pub fn stage_text(stage: &UsdStage, provenance: &Provenance) -> Result<String> {
    let UsdStage { path, up, meters_per_unit, fps, sequences } = stage;
    let lists = || sequences.iter().flat_map(|sequence| [&sequence.meshes, &sequence.volumes]);
    lists().try_for_each(|files| check(files))?;
    check_path(path)?;
    let codes = || lists().flatten().map(|file| file.code);
    let Some(range) = codes().min().zip(codes().max()) else {
        return Err(invalid("a stage needs at least one frame".to_owned()));
    };
    let mut text = head(provenance, (None, &[]), (*up, *meters_per_unit), &times(range.into(), *fps));
    text += &manifest(sequences);
    let has_points = sequences.iter().any(|sequence| sequence.are_points);
    let mut used = UsedNames::new(if has_points { &[PRIM, POINTS_PRIM] } else { &[PRIM] });
    for sequence in sequences {
        let name = used.take(&identifier(&sequence.name));
        if !sequence.meshes.is_empty() || !sequence.volumes.is_empty() {
            text += &sequence_text(sequence, &name, path);
        }
    }
    let (mut meshes, mut points, mut volumes) = (0, 0, 0);
    for sequence in sequences {
        *(if sequence.are_points { &mut points } else { &mut meshes }) += sequence.meshes.len();
        volumes += sequence.volumes.len();
    }
    let points = if points > 0 { format!(", {points} files of points") } else { String::new() };
    Ok(text + &format!("}}\n\n{LAST_LINE}{meshes} meshes, {volumes} volumes{points}\n"))
}

fn invalid(what: String) -> Error {
    Error::invalid(FORMAT, Position::File, what)
}

fn check(files: &[ClipFile]) -> Result<()> {
    check_numbers(FORMAT, files.iter().map(|file| (file.path.as_str(), file.code)))?;
    files.iter().try_for_each(|file| check_path(&file.path))
}

fn check_path(path: &str) -> Result<()> {
    if path.contains(char::is_control) {
        Err(invalid(format!("{path:?} has control characters, which USD does not allow")))
    } else {
        Ok(())
    }
}

/// The manifest: the attributes of all sequences, without values. Empty if there are no meshes and points.
fn manifest(sequences: &[StageClips]) -> String {
    let of = |are_points: bool| {
        let (mut lines, mut names) = (String::new(), HashSet::new());
        let sequences = sequences.iter().filter(|sequence| sequence.are_points == are_points);
        for SampledProperty { kind, name } in sequences.flat_map(|sequence| &sequence.properties) {
            if names.insert(name) {
                lines += &format!("        {kind} {name}\n");
            }
        }
        let prim = prim_of(are_points);
        if names.is_empty() {
            String::new()
        } else {
            format!("    over \"{prim}\"\n    {{\n{lines}    }}\n\n")
        }
    };
    of(false) + &of(true)
}

/// The name of the prim in the file of a frame.
fn prim_of(are_points: bool) -> &'static str {
    if are_points { POINTS_PRIM } else { PRIM }
}

/// The prim of a sequence in the stage with this path.
fn sequence_text(sequence: &StageClips, name: &str, stage: &str) -> String {
    let StageClips { are_points, meshes, declared_by, volumes, has_velocity, .. } = sequence;
    let mut text = format!("    def Xform \"{name}\"");
    if let Some(declared) = meshes.get(*declared_by).map(|file| asset(&file.path)) {
        text += &clips(meshes, &declared, &asset(stage));
    }
    text += "\n    {\n";
    if !meshes.is_empty() {
        text += &format!(
            "        over \"{}\"\n        {{\n            uniform token[] xformOpOrder = [\"{TRANSLATE}\"]\n        }}\n",
            prim_of(*are_points)
        );
    }
    if !volumes.is_empty() {
        // The surface would be rendered twice.
        let is_hidden = !meshes.is_empty();
        let path = format!("/{ROOT}/{name}/{VOLUME}");
        text += &volume(&path, volumes, *has_velocity, is_hidden);
    }
    text + "    }\n"
}

/// The name of the volume.
const VOLUME: &str = "volume";

/// The metadata that makes all values come from the files of the frames.
fn clips(meshes: &[ClipFile], declared: &str, manifest: &str) -> String {
    let (mut active, mut times) = (Vec::new(), Vec::new());
    for (index, file) in meshes.iter().enumerate() {
        for code in held_times(file.code, meshes.get(index + 1).map(|next| next.code)) {
            active.push(format!("({code}, {index})"));
            times.push(format!("({code}, {SAMPLE_CODE})"));
        }
    }
    let assets: Vec<String> = meshes.iter().map(|file| asset(&file.path)).collect();
    let [active, times, assets] = [active, times, assets].map(|list| list.join(", "));
    format!(
        " (
        clips = {{
            dictionary default = {{
                double2[] active = [{active}]
                asset[] assetPaths = [{assets}]
                asset manifestAssetPath = {manifest}
                string primPath = \"/{ROOT}\"
                double2[] times = [{times}]
            }}
        }}
        references = {declared}
    )"
    )
}

/// The prim of the level sets, with one child for each grid.
fn volume(path: &str, files: &[ClipFile], has_velocity: bool, is_hidden: bool) -> String {
    const LEVEL_SET: [&str; 4] = [
        "surface",
        "token fieldClass = \"levelSet\"",
        "token fieldDataType = \"float\"",
        "token fieldName = \"surface\"",
    ];
    const VELOCITY: [&str; 4] = [
        "velocity",
        "token fieldDataType = \"float3\"",
        "token fieldName = \"velocity\"",
        "token vectorDataRoleHint = \"Vector\"",
    ];
    let grids = [Some(LEVEL_SET), has_velocity.then_some(VELOCITY)].into_iter().flatten();
    let mut text = format!("        def Volume \"{VOLUME}\"\n        {{\n");
    for [grid, ..] in grids.clone() {
        text += &format!("            rel field:{grid} = <{path}/{grid}>\n");
    }
    text += if is_hidden { "            token visibility = \"invisible\"\n" } else { "" };
    for [grid, lines @ ..] in grids {
        text += &format!("\n            def OpenVDBAsset \"{grid}\"\n            {{\n");
        text += "                asset filePath.timeSamples = {\n";
        for ClipFile { code, path } in files {
            text += &format!("                    {code}: {},\n", asset(path));
        }
        text += "                }\n";
        for line in lines {
            text += &format!("                {line}\n");
        }
        text += "            }\n";
    }
    text + "        }\n"
}

/// A path between its delimiters.
fn asset(path: &str) -> String {
    if path.contains('@') { format!("@@@{}@@@", path.replace("@@@", "\\@@@")) } else { format!("@{path}@") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::sequence::NUMBER_MAX;

    fn files(codes: &[i64], extension: &str) -> Vec<ClipFile> {
        let file = |&code: &i64| ClipFile { code, path: format!("./out/dam.{code}.{extension}") };
        codes.iter().map(file).collect()
    }

    fn stage(sequences: Vec<StageClips>) -> UsdStage {
        let path = "./shot.usda".to_owned();
        UsdStage { path, up: UpAxis::Z, meters_per_unit: 0.01, fps: 25.0, sequences }
    }

    fn text(sequences: Vec<StageClips>) -> String {
        stage_text(&stage(sequences), &[("generator".to_owned(), "meniscus".to_owned())]).expect("a stage")
    }

    #[test]
    fn stage_of_meshes_maps_times_to_files_and_holds_each_until_the_next() {
        let meshes = files(&[1, 2, 5], "usdc");
        let name = "dam".to_owned();
        let property = |kind: &str, name: &str| SampledProperty::checked(kind, name).expect("valid");
        let properties = vec![property("point3f[]", "points"), property("int[]", "primvars:id")];
        let text =
            text(vec![StageClips { name, meshes, declared_by: 1, properties, ..StageClips::default() }]);
        assert_eq!(
            text,
            "#usda 1.0
(
    customLayerData = {
        dictionary meniscus = {
            string generator = \"meniscus\"
        }
    }
    defaultPrim = \"root\"
    endTimeCode = 5
    framesPerSecond = 25
    startTimeCode = 1
    timeCodesPerSecond = 25
    metersPerUnit = 0.01
    upAxis = \"Z\"
)

def Xform \"root\"
{
    over \"surface\"
    {
        point3f[] points
        int[] primvars:id
    }

    def Xform \"dam\" (
        clips = {
            dictionary default = {
                double2[] active = [(1, 0), (1.984375, 0), (2, 1), (4.984375, 1), (5, 2)]
                asset[] assetPaths = [@./out/dam.1.usdc@, @./out/dam.2.usdc@, @./out/dam.5.usdc@]
                asset manifestAssetPath = @./shot.usda@
                string primPath = \"/root\"
                double2[] times = [(1, 0), (1.984375, 0), (2, 0), (4.984375, 0), (5, 0)]
            }
        }
        references = @./out/dam.2.usdc@
    )
    {
        over \"surface\"
        {
            uniform token[] xformOpOrder = [\"xformOp:translate\"]
        }
    }
}

# end: 3 meshes, 0 volumes
"
        );
        assert!(crate::core::text::ends_with_line(text.as_bytes(), LAST_LINE));
    }

    #[test]
    fn volume_alone_is_visible_and_has_its_velocity() {
        let volumes = files(&[7, 9], "vdb");
        let sequence =
            StageClips { name: "dam".to_owned(), volumes, has_velocity: true, ..StageClips::default() };
        let text = text(vec![sequence.clone()]);
        let (_, volume) = text.split_once("    def Xform \"dam\"\n    {\n").expect("no clips");
        assert_eq!(
            volume.replace(&format!("/{ROOT}/dam/volume"), "PATH"),
            "        def Volume \"volume\"
        {
            rel field:surface = <PATH/surface>
            rel field:velocity = <PATH/velocity>

            def OpenVDBAsset \"surface\"
            {
                asset filePath.timeSamples = {
                    7: @./out/dam.7.vdb@,
                    9: @./out/dam.9.vdb@,
                }
                token fieldClass = \"levelSet\"
                token fieldDataType = \"float\"
                token fieldName = \"surface\"
            }

            def OpenVDBAsset \"velocity\"
            {
                asset filePath.timeSamples = {
                    7: @./out/dam.7.vdb@,
                    9: @./out/dam.9.vdb@,
                }
                token fieldDataType = \"float3\"
                token fieldName = \"velocity\"
                token vectorDataRoleHint = \"Vector\"
            }
        }
    }
}

# end: 0 meshes, 2 volumes
"
        );
        let both = StageClips { meshes: files(&[7], "usdc"), has_velocity: false, ..sequence };
        let both = super::stage_text(&stage(vec![both]), &[]).expect("a stage");
        assert!(both.contains("token visibility = \"invisible\"") && !both.contains("velocity"), "{both}");
    }

    #[test]
    fn sequences_have_prims_of_their_own() {
        let sequence = |name: &str| {
            let meshes = files(&[1], "usda");
            StageClips { name: name.to_owned(), meshes, ..StageClips::default() }
        };
        let prims = |sequences: &[StageClips]| -> Vec<String> {
            let text = text(sequences.to_vec());
            let names = text.lines().filter_map(|line| line.strip_prefix("    def Xform "));
            names.map(|name| name.trim_end_matches(" (").to_owned()).collect()
        };
        let mut sequences = ["2 drops", "a.b", "a b", "surface"].map(sequence);
        assert_eq!(prims(&sequences), ["\"_2_drops\"", "\"a_b\"", "\"a_b_2\"", "\"surface_2\""]);
        // A sequence keeps its name while the one before it has no files yet.
        sequences[1].meshes.clear();
        assert_eq!(prims(&sequences), ["\"_2_drops\"", "\"a_b_2\"", "\"surface_2\""]);
    }

    #[test]
    fn manifest_lists_each_attribute_once() {
        let sequence = |names: &[&str]| {
            let property = |name: &&str| SampledProperty::checked("int[]", name).expect("valid");
            let properties = names.iter().map(property).collect();
            StageClips { meshes: files(&[1], "usdc"), properties, ..StageClips::default() }
        };
        let text = text(vec![sequence(&["points", "age"]), sequence(&["points", "id"])]);
        let (_, manifest) = text.split_once("    over \"surface\"\n    {\n").expect("a manifest");
        let (manifest, _) = manifest.split_once("    }\n\n").expect("an end");
        assert_eq!(manifest, "        int[] points\n        int[] age\n        int[] id\n");
    }

    #[test]
    fn paths_with_the_delimiter_are_quoted_and_with_control_characters_refused() {
        assert_eq!(asset("./a b/ü.usdc"), "@./a b/ü.usdc@");
        assert_eq!(asset("./a@@@b@.usdc"), "@@@./a\\@@@b@.usdc@@@");
        let with = |files: Vec<ClipFile>| {
            stage_text(&stage(vec![StageClips { meshes: files, ..StageClips::default() }]), &[])
        };
        let file = |code, path: &str| ClipFile { code, path: path.to_owned() };
        for refused in [
            vec![],
            vec![file(1, "a\nb")],
            vec![file(2, "a"), file(2, "b")],
            vec![file(1, "a"), file(NUMBER_MAX + 1, "b")],
            vec![file(-NUMBER_MAX - 1, "a")],
        ] {
            assert!(with(refused).is_err());
        }
    }
}
