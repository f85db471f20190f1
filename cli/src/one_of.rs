//! Options whose values are constants of the libraries.

use clap::builder::{PossibleValuesParser, TypedValueParser};

/// Parses each of these names to the value beside it. Help, completions and errors list the names.
pub fn one_of<T: Copy + Send + Sync + 'static>(
    values: &'static [(&'static str, T)],
) -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(values.iter().map(|(name, _)| *name)).try_map(move |given| {
        let found = values.iter().find(|(name, _)| *name == given);
        found.map(|(_, value)| *value).ok_or("this value is not listed")
    })
}
