//! Warnings about frames that were converted.

use std::collections::HashSet;
use std::fmt;
use std::path::Path;

use crate::surface::words::pluralize;

/// A warning about a converted frame. Its `Display` form is its sentence, and the remedy.
#[derive(Clone, Debug, PartialEq)]
pub struct Warning {
    /// The fact.
    pub sentence: String,
    /// The options of the program that correct the cause.
    pub remedy: Option<String>,
    /// Whether the fact says nothing about the other frames of the sequence.
    pub is_of_frame: bool,
    /// Whether the frame has a fault that does not depend on the settings: ignored particles, or failed validation.
    pub is_flaw: bool,
    /// What the sentence is about, such as an attribute, if it may be about several.
    pub subject: String,
}

impl Warning {
    /// A warning that usually holds for the later frames of the sequence, too.
    pub fn new(sentence: impl Into<String>) -> Warning {
        let sentence = sentence.into();
        Warning { sentence, remedy: None, is_of_frame: false, is_flaw: false, subject: String::new() }
    }

    /// A warning about this frame only.
    pub fn of_frame(sentence: impl Into<String>) -> Warning {
        Warning { is_of_frame: true, ..Warning::new(sentence) }
    }

    /// A failed check of the result.
    pub(crate) fn violation(what: impl fmt::Display) -> Warning {
        Warning { is_flaw: true, ..Warning::of_frame(format!("failed validation: {what}")) }
    }

    /// A likely mistake in an obstacle.
    pub(crate) fn of_obstacle(path: &Path, finding: &str) -> Warning {
        Warning::new(format!("obstacle {}: {finding}", path.display())).about(path.to_string_lossy())
    }

    pub(crate) fn about(self, subject: impl Into<String>) -> Warning {
        Warning { subject: subject.into(), ..self }
    }

    pub(crate) fn with_remedy(self, remedy: impl Into<String>) -> Warning {
        Warning { remedy: Some(remedy.into()), ..self }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.sentence)?;
        self.remedy.iter().try_for_each(|remedy| write!(f, "; {remedy}"))
    }
}

/// A sentence in which `{}` is this number of things, unless it is 0.
pub(crate) fn counted(count: usize, noun: &str, sentence: &str) -> Option<String> {
    (count > 0).then(|| sentence.replace("{}", &pluralize(count, noun)))
}

/// How to get velocities that a file lacks.
pub(crate) const COMPUTED_VELOCITIES: &str = "--time-step SECONDS, the time from one frame to the next, computes velocities from the frames before and after";

/// The warnings of a sequence that were reported already: their sentences without numbers, and their subjects.
#[derive(Clone, Debug, Default)]
pub struct ReportedWarnings(HashSet<(String, String)>);

impl ReportedWarnings {
    /// Whether a warning is to be reported: it is about one frame, or the first one with its words and subject.
    pub fn is_new(&mut self, warning: &Warning) -> bool {
        let is_word = |c: &char| !c.is_ascii_digit() && !".-".contains(*c);
        let words = warning.sentence.chars().filter(is_word).collect();
        warning.is_of_frame || self.0.insert((words, warning.subject.clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_of_a_sequence_are_reported_once_for_each_subject() {
        let mut reported = ReportedWarnings::default();
        let missing = |name: &str| Warning::new(format!("no attribute `{name}`")).about(name);
        for (warning, is_new) in [
            (missing("v1"), true),
            (missing("v2"), true),
            (missing("v1"), false),
            (Warning::new("3 columns are not read"), true),
            (Warning::new("14 columns are not read"), false),
            (Warning::new("-0.25 rows are not read"), true),
            (Warning::of_obstacle("a1.obj".as_ref(), "flat"), true),
            (Warning::of_obstacle("a2.obj".as_ref(), "flat"), true),
            (Warning::of_obstacle("a1.obj".as_ref(), "flipped 1"), true),
            (Warning::of_obstacle("a1.obj".as_ref(), "flipped 9"), false),
            (Warning::of_frame("1 particle left out"), true),
            (Warning::of_frame("1 particle left out"), true),
        ] {
            assert_eq!(reported.is_new(&warning), is_new, "{warning}");
        }
    }
}
