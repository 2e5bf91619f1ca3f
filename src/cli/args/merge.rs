//! Operations on every struct of options: list the options that are given, and merge the options of the
//! command line with those of a file.

/// Options that may be absent.
pub(in crate::cli) trait OptionSet: Sized {
    /// These options, and those of `below` where `self` has none.
    fn over(self, below: Self) -> Self;

    /// Adds the names of the options that are given, such as `up`; `name` is the name of the field that
    /// contains this option or set of options.
    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>);

    /// The names of the options that are given.
    fn given(&self) -> Vec<&'static str> {
        let mut given = Vec::new();
        self.add_given("", &mut given);
        given
    }
}

impl<T> OptionSet for Option<T> {
    fn over(self, below: Self) -> Self {
        self.or(below)
    }

    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>) {
        given.extend(self.is_some().then_some(name));
    }
}

impl<T> OptionSet for Vec<T> {
    fn over(self, below: Self) -> Self {
        if self.is_empty() { below } else { self }
    }

    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>) {
        given.extend((!self.is_empty()).then_some(name));
    }
}

impl OptionSet for bool {
    fn over(self, below: Self) -> Self {
        self || below
    }

    fn add_given(&self, name: &'static str, given: &mut Vec<&'static str>) {
        given.extend(self.then_some(name));
    }
}

/// Defines a struct of options, each a field with its help, and implements the operations on it.
macro_rules! option_set {
    (
        $(#[$attribute:meta])*
        $visibility:vis struct $name:ident {
            $($(#[$field_attribute:meta])* $field_visibility:vis $field:ident: $type:ty,)+
        }
    ) => {
        $(#[$attribute])*
        $visibility struct $name {
            $($(#[$field_attribute])* $field_visibility $field: $type,)+
        }

        impl $crate::cli::args::OptionSet for $name {
            fn over(self, below: $name) -> $name {
                $name { $($field: $crate::cli::args::OptionSet::over(self.$field, below.$field),)+ }
            }

            fn add_given(&self, _: &'static str, given: &mut Vec<&'static str>) {
                $($crate::cli::args::OptionSet::add_given(&self.$field, stringify!($field), given);)+
            }
        }
    };
}
pub(in crate::cli) use option_set;
