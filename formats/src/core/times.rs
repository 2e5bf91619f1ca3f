//! Refuses the particles of several frames that one table or list joins.

use crate::core::columns::without_unit;
use crate::core::data::{AttributeRole, FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Result};
use crate::core::number::wide;
use crate::core::text::excerpt;

/// Names of the time of a frame, in lower case.
const TIMES: [&str; 13] = [
    "time",
    "timestep",
    "time_step",
    "time step",
    "timestamp",
    "sim_time",
    "tstep",
    "step",
    "frame",
    "snapshot",
    "iteration",
    "cycle",
    "frame_number",
];

/// Whether numbers of this name are the time of a frame.
pub(crate) fn is_time(name: &str) -> bool {
    TIMES.contains(&&*without_unit(name).to_ascii_lowercase())
}

/// Whether numbers of this name may be the time of a frame.
pub(crate) fn may_be_time(name: &str) -> bool {
    is_time(name) || without_unit(name) == "t"
}

/// Refuses particles that have the times of several frames: ids that repeat or, without ids, times in ascending
/// order show that these are not times of the particles.
///
/// # Errors
/// [`Error::Unsupported`], with two of the times.
pub(crate) fn refuse_several_frames(format: &'static str, frame: &ParticleFrame) -> Result<()> {
    let numbers = |find: &dyn Fn(&FileAttribute) -> bool| {
        frame.attributes.iter().find(|attribute| attribute.arity == 1 && find(attribute))
    };
    let time = numbers(&|attribute| is_time(&attribute.name));
    let Some(time) = time.or_else(|| numbers(&|attribute| may_be_time(&attribute.name))) else {
        return Ok(());
    };
    let times = wide(&time.values);
    let mut known = times.iter().filter(|time| !time.is_nan());
    let first = known.next();
    let Some((first, other)) = first.zip(known.find(|&time| Some(time) != first)) else { return Ok(()) };
    let is_several = match numbers(&|attribute| attribute.role == Some(AttributeRole::Id)) {
        Some(ids) => has_twins(&ids.values),
        None => times.is_sorted() && is_time(&time.name),
    };
    if !is_several {
        return Ok(());
    }
    let what = format!(
        "`{}` has several values, such as {first} and {other}, so the file joins several frames: save each as a file \
         of its own",
        excerpt(&time.name)
    );
    Err(Error::unsupported(format, what))
}

/// Whether two values are equal. 64-bit integers are compared exactly.
fn has_twins(values: &Values) -> bool {
    if let Values::I64(integers) = values {
        let mut integers = integers.clone();
        integers.sort_unstable();
        return integers.windows(2).any(|pair| pair[0] == pair[1]);
    }
    let mut reals = wide(values);
    reals.sort_unstable_by(f64::total_cmp);
    reals.windows(2).any(|pair| pair[0] == pair[1])
}
