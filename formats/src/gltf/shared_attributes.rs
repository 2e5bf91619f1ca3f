//! The vertex attributes that a sequence can have: those of all its frames.

use super::frame_file::{GlbFrame, NORMAL, POSITION, VertexColumn};
use super::sequence::SequenceFrame;
use super::vertex_data::usual_name;
use crate::error::Result;

/// A vertex attribute that all frames with a mesh have.
pub(crate) struct SharedAttribute {
    /// Its name in the frames' `.glb` files.
    pub(crate) semantic: String,
    /// Its name in the first frame with a name of its own. A format may have a property for it instead.
    pub(crate) name: String,
    /// Number of values per vertex.
    pub(crate) arity: usize,
}

/// The attributes that all frames with a mesh have, in the order of their names in the `.glb` files, and
/// notes on the others. Positions and normals are not among them: every mesh has these.
///
/// # Errors
///
/// [`Error::Invalid`](crate::Error::Invalid) if a document is damaged.
pub(crate) fn shared_attributes(frames: &[SequenceFrame]) -> Result<(Vec<SharedAttribute>, Vec<String>)> {
    let files: Vec<&GlbFrame> =
        frames.iter().map(|frame| &frame.file).filter(|file| file.has_mesh()).collect();
    let mut semantics: Vec<&String> = Vec::new();
    for file in &files {
        semantics.extend(file.attributes()?.keys());
    }
    semantics.sort();
    semantics.dedup();
    let (mut shared, mut notes) = (Vec::new(), Vec::new());
    for semantic in semantics.into_iter().filter(|semantic| ![NORMAL, POSITION].contains(&semantic.as_str()))
    {
        match arity(&files, semantic)? {
            Ok(arity) => {
                let own_name = files.iter().find_map(|file| file.own_name(semantic));
                let name = own_name.map_or_else(|| usual_name(semantic), str::to_owned);
                shared.push(SharedAttribute { semantic: semantic.clone(), name, arity });
            }
            Err(why) => notes.push(format!("{semantic} is missing in the sequence: {why}")),
        }
    }
    Ok((shared, notes))
}

/// The number of values per vertex of an attribute, or why a sequence cannot have it.
fn arity(files: &[&GlbFrame], semantic: &str) -> Result<std::result::Result<usize, &'static str>> {
    if files.iter().any(|file| file.has_string_indices(semantic)) {
        return Ok(Err("its values are strings, and each frame has its own table"));
    }
    let columns: Vec<Option<VertexColumn>> =
        files.iter().map(|file| file.column(semantic)).collect::<Result<_>>()?;
    let mut arities = columns.iter().map(|column| column.map(|column| column.arity));
    let first = arities.next().flatten().filter(|first| arities.all(|arity| arity == Some(*first)));
    Ok(first.ok_or("not all frames have it with the same number of values per vertex"))
}
