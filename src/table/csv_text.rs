//! A table as CSV text.

use super::{Column, ColumnData, Table};
use rayon::prelude::*;
use std::io::Write as _;

/// Rows that one task formats; fixed, so that the work is cut in the same way everywhere.
const ROWS_PER_TASK: usize = 8192;

pub(super) fn encode(table: &Table) -> Vec<u8> {
    let columns: Vec<&Column> =
        table.columns().iter().filter(|c| !matches!(c.data, ColumnData::Wkb { .. })).collect();
    let mut out = writer(1 << 10);
    for column in &columns {
        field(&mut out, column.name.as_bytes());
    }
    end_record(&mut out, columns.len());
    let mut text = finish(out);

    let rows = table.rows();
    let parts: Vec<Vec<u8>> = (0..rows.div_ceil(ROWS_PER_TASK))
        .into_par_iter()
        .map(|task| {
            let range = task * ROWS_PER_TASK..rows.min((task + 1) * ROWS_PER_TASK);
            encode_rows(&columns, range)
        })
        .collect();
    text.reserve_exact(parts.iter().map(Vec::len).sum());
    for part in &parts {
        text.extend_from_slice(part);
    }
    text
}

fn encode_rows(columns: &[&Column], range: std::ops::Range<usize>) -> Vec<u8> {
    let mut out = writer(range.len() * columns.len() * 12);
    let mut number = Vec::with_capacity(32);
    for row in range {
        for column in columns {
            number.clear();
            match &column.data {
                ColumnData::Utf8(values) => {
                    field(&mut out, values[row].as_deref().unwrap_or_default().as_bytes());
                    continue;
                }
                ColumnData::Dictionary { values, keys } => {
                    let text = keys[row].map_or("", |key| values[key as usize].as_str());
                    field(&mut out, text.as_bytes());
                    continue;
                }
                ColumnData::F64(values) => push_f64(&mut number, values[row]),
                ColumnData::I64(values) => {
                    if let Some(value) = values[row] {
                        write!(number, "{value}").expect("memory can be written to");
                    }
                }
                ColumnData::Bool(values) => match values[row] {
                    Some(true) => number.extend_from_slice(b"true"),
                    Some(false) => number.extend_from_slice(b"false"),
                    None => {}
                },
                ColumnData::Wkb { .. } => {}
            }
            field(&mut out, &number);
        }
        end_record(&mut out, columns.len());
    }
    finish(out)
}

/// The shortest text that reads back to the same number; nothing for NaN.
fn push_f64(out: &mut Vec<u8>, value: f64) {
    if value.is_nan() {
        return;
    }
    let size = value.abs();
    // Without an exponent, `1e300` would be 301 digits long.
    if size != 0.0 && size.is_finite() && !(1e-7..1e17).contains(&size) {
        write!(out, "{value:e}").expect("memory can be written to");
    } else {
        write!(out, "{value}").expect("memory can be written to");
    }
}

fn writer(capacity: usize) -> csv::Writer<Vec<u8>> {
    csv::WriterBuilder::new().from_writer(Vec::with_capacity(capacity))
}

fn field(out: &mut csv::Writer<Vec<u8>>, bytes: &[u8]) {
    out.write_field(bytes).expect("memory can be written to");
}

fn end_record(out: &mut csv::Writer<Vec<u8>>, fields: usize) {
    // A record without fields would come out as `""`.
    if fields > 0 {
        out.write_record(None::<&[u8]>).expect("memory can be written to");
    }
}

fn finish(out: csv::Writer<Vec<u8>>) -> Vec<u8> {
    out.into_inner().expect("memory can be written to")
}

#[cfg(test)]
mod tests {
    use super::super::{Column, ColumnData, Table};
    use proptest::prelude::*;

    #[test]
    fn quoting_missing_values_and_line_ends() {
        let table = Table::new(vec![
            Column::new(
                "panorama",
                "",
                ColumnData::Utf8(vec![
                    Some("a,1,2,.jpg".to_owned()),
                    Some("say \"x\"".to_owned()),
                    None,
                ]),
            ),
            Column::f64("f", "", [1.0, f64::NAN, -2.5e-9]),
            Column::i64("i", "", [Some(7), None, Some(-1)]),
            Column::bool("b", "", [Some(true), None, Some(false)]),
            Column::geometry("g", "", vec![None, None, None]),
            Column::dictionary("d", "", vec!["x".into(), "y".into()], [Some(1), Some(0), None]),
        ])
        .expect("a table");
        let text = String::from_utf8(table.to_csv()).expect("text");
        assert_eq!(
            text,
            "panorama,f,i,b,d\n\"a,1,2,.jpg\",1,7,true,y\n\"say \"\"x\"\"\",,,,x\n,-2.5e-9,-1,false,\n"
        );
    }

    #[test]
    fn tables_without_columns_or_rows() {
        assert_eq!(Table::new(Vec::new()).expect("a table").to_csv(), b"");
        let header = Table::new(vec![Column::f64("x", "", Vec::<f64>::new())]).expect("a table");
        assert_eq!(header.to_csv(), b"x\n");
        // One column whose value is missing: the line must not look like no line at all.
        let hole = Table::new(vec![Column::f64("x", "", [f64::NAN])]).expect("a table");
        assert_eq!(hole.to_csv(), b"x\n\"\"\n");
    }

    #[test]
    fn many_tasks_make_the_same_text_as_one() {
        let n = 2 * super::ROWS_PER_TASK + 17;
        let table = Table::new(vec![Column::i64("i", "", 0..n as i64)]).expect("a table");
        let expected: String = std::iter::once("i".to_owned())
            .chain((0..n).map(|i| i.to_string()))
            .fold(String::new(), |text, line| text + &line + "\n");
        assert_eq!(table.to_csv(), expected.as_bytes());
    }

    proptest! {
        #[test]
        fn numbers_and_text_come_back(
            rows in prop::collection::vec((any::<f64>(), any::<i64>(), "\\PC*|[\"\r\n, ]*"), 1..20)
        ) {
            let table = Table::new(vec![
                Column::f64("f", "", rows.iter().map(|r| r.0)),
                Column::i64("i", "", rows.iter().map(|r| r.1)),
                Column::text("t", "", rows.iter().map(|r| r.2.as_str())),
            ]).expect("a table");
            let bytes = table.to_csv();
            let mut reader = csv::Reader::from_reader(bytes.as_slice());
            let read: Vec<csv::StringRecord> =
                reader.records().collect::<Result<_, _>>().expect("records");
            prop_assert_eq!(read.len(), rows.len());
            for (record, (f, i, t)) in read.iter().zip(&rows) {
                if f.is_nan() {
                    prop_assert_eq!(&record[0], "");
                } else {
                    prop_assert_eq!(record[0].parse::<f64>().expect("a number").to_bits(), f.to_bits());
                }
                prop_assert_eq!(record[1].parse::<i64>().expect("a number"), *i);
                prop_assert_eq!(&record[2], t.as_str());
            }
        }
    }
}
