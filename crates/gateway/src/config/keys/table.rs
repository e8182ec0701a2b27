//! The notation of the tables.

/// Declares tables: for each a type with its keys as fields, a constant of it, its schema and its documentation.
macro_rules! keys {
    ($($(#[doc = $about:literal])+ $constant:ident: $table:ident {
        $($(#[doc = $meaning:literal])+ $key:ident: $type:ty = $form:expr, $kind:ident $($default:expr)?;)*
    })+) => {$(
        pub(in crate::config) struct $table {
            $(pub(in crate::config) $key: Key<$type>,)*
        }

        pub(in crate::config) const $constant: $table = $table {
            $($key: Key {
                name: key_name(stringify!($key)),
                form: &$form,
                default: keys!(@ $kind $($default)?),
                meaning: concat!($($meaning),+),
            },)*
        };

        impl $table {
            /// The JSON Schema of the table.
            pub(super) fn schema() -> Value {
                let required = |default: &Preset| matches!(default, Preset::Required);
                table(concat!($($about),+), vec![
                    $((key_name(stringify!($key)), required(&$constant.$key.default), $constant.$key.schema()),)*
                ])
            }
        }
    )+

        /// Each table by the name of its type, with its rows in the documentation.
        #[cfg(test)]
        pub(super) fn documentation() -> Vec<(&'static str, Vec<[String; 4]>)> {
            vec![$((stringify!($table), vec![$($constant.$key.row(),)*]),)+]
        }
    };
    (@ required) => { Preset::Required };
    (@ by_protocol $default:expr) => { Preset::ByProtocol($default) };
    (@ or $words:expr) => { Preset::Words($words) };
    (@ default $value:expr) => { Preset::Value(stringify!($value)) };
}
