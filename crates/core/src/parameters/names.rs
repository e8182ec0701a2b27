//! The user's own list of names: CSV with the columns id, name, unit, scale.

use std::collections::BTreeMap;

use super::file::Id;
use drivegate_model::drive::parameters::Label;

/// Maximum number of rows of a list.
const MOST_ROWS: usize = 10_000;

/// Names of parameters by id.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Names(BTreeMap<Id, Label>);

impl Names {
    /// Reads a list: comma or semicolon between fields, double quotes around fields that contain one; the first row
    /// may have the names of the columns. `scale` is the value of one count; unit and scale may be empty.
    ///
    /// # Errors
    /// If the text is not a list of names: contains the fault and its line.
    pub fn parse(text: &str) -> Result<Names, String> {
        let mut names = BTreeMap::new();
        for (number, line) in (1..).zip(text.trim_start_matches('\u{feff}').lines()) {
            if number > MOST_ROWS {
                return Err(format!("line {number}: more than {MOST_ROWS} rows"));
            }
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let (fields, closed) = cells(line, |c| matches!(c, ',' | ';'));
            if !closed {
                return Err(format!("line {number}: a quote is not closed"));
            }
            let field = |index: usize| fields.get(index).map_or("", |field| field.trim());
            if number == 1 && field(0).eq_ignore_ascii_case("id") {
                continue;
            }
            if field(0).is_empty() || fields.len() > 4 {
                return Err(format!("line {number}: expected id, name, unit, scale"));
            }
            let scale = match field(3) {
                "" => 0.0,
                text => text
                    .parse()
                    .ok()
                    .filter(|scale: &f64| scale.is_finite() && *scale > 0.0)
                    .ok_or_else(|| format!("line {number}: the scale `{text}` is not a number above 0"))?,
            };
            let label = Label {
                name: field(1).to_string(),
                unit: field(2).to_string(),
                scale,
            };
            names.insert(Id::new(field(0)), label);
        }
        Ok(Names(names))
    }

    /// The label of the parameter with this id.
    pub fn get(&self, id: &Id) -> Option<&Label> {
        self.0.get(id)
    }
}

/// Cells of a CSV line, and whether all quotes are closed; a quoted cell may contain separators and doubled quotes.
pub fn cells(line: &str, is_separator: impl Fn(char) -> bool) -> (Vec<String>, bool) {
    let (mut cells, mut cell) = (Vec::new(), String::new());
    let (mut quoted, mut chars) = (false, line.chars().peekable());
    while let Some(c) = chars.next() {
        match c {
            '"' if quoted && chars.peek() == Some(&'"') => {
                chars.next();
                cell.push('"');
            }
            '"' => quoted = !quoted,
            c if is_separator(c) && !quoted => cells.push(std::mem::take(&mut cell)),
            c => cell.push(c),
        }
    }
    cells.push(cell);
    (cells, !quoted)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_as_spreadsheets_write_them() {
        let list = "id;name;unit;scale\n1.2;Maximum frequency;Hz;0,1\n";
        assert_eq!(
            Names::parse(list).unwrap_err(),
            "line 2: expected id, name, unit, scale".to_string()
        );
        let list = "\u{feff}id,name,unit,scale\r\n1.2,\"Maximum frequency, \"\"fmax\"\"\",Hz,0.1\r\n\r\n1.3,Ramp\r\n";
        let names = Names::parse(list).unwrap();
        let label = names.get(&Id::new("1.2")).unwrap();
        assert_eq!(
            (label.name.as_str(), label.unit.as_str(), label.scale),
            ("Maximum frequency, \"fmax\"", "Hz", 0.1)
        );
        assert_eq!(names.get(&Id::new("1.3")).unwrap().scale, 0.0);
        assert!(Names::parse("1.2,\"open").unwrap_err().contains("line 1"));
        assert!(Names::parse("1.2,a,b,-1").unwrap_err().contains("above 0"));
    }
}
