//! What is written of each frame: formats, pictures, and the camera of these.
//!
//! ```text
//!   outputs     formats and their options                stored       positions as files hold them
//!   picture     surfaces to pictures                     viewpoint    where they are taken from
//!   framing     the camera of a sequence                 close_up     the part of a picture worth a look
//! ```

pub(super) mod close_up;
pub(super) mod framing;
pub(super) mod outputs;
pub(super) mod picture;
pub(super) mod stored;
pub(super) mod viewpoint;
