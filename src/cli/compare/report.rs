//! The comparison as one HTML file that needs nothing else.

use super::Shown;
use super::table::Table;
use crate::cli::page::{self, image};
use crate::picture::chart::escape;
use std::fmt::Write;

/// The page: the table with the best of every column set off, and every mesh from one view.
pub(super) fn html(table: &Table, pictures: &[Shown], dataset: &str) -> String {
    let lead = format!("Equal budgets on {dataset}; mean ± standard deviation over seeds.");
    let mut page = page::begin("Comparison", &lead);
    page.push_str("</header><section><table><tr><th>method</th>");
    let columns = table.columns();
    for column in &columns {
        let _ = write!(page, "<th>{}</th>", escape(&column.head));
    }
    page.push_str("</tr>");
    for method in table.methods() {
        let _ = write!(page, "<tr><td>{}</td>", escape(method));
        for column in &columns {
            let all = table
                .methods()
                .filter_map(|method| table.cell(method, column));
            let best = all.map(|cell| cell.mean).reduce(|a, b| {
                if column.more_is_better {
                    a.max(b)
                } else {
                    a.min(b)
                }
            });
            let cell = match table.cell(method, column) {
                None => "–".into(),
                Some(cell) if Some(cell.mean) == best => {
                    format!("<b>{}</b>", escape(&cell.text(column.decimals)))
                }
                Some(cell) => escape(&cell.text(column.decimals)),
            };
            let _ = write!(page, "<td>{cell}</td>");
        }
        page.push_str("</tr>");
    }
    page.push_str("</table>");
    let failures = table.failures();
    if !failures.is_empty() {
        let _ = write!(page, "<p>Failed:</p><pre>{}</pre>", escape(&failures));
    }
    page.push_str("</section><section><h2>Meshes</h2><div class=\"heroes\">");
    for shown in pictures {
        let _ = write!(
            page,
            "<figure>{}<figcaption>{}</figcaption></figure>",
            image(&shown.picture, &shown.name),
            escape(&shown.name)
        );
    }
    page.push_str("</div></section>");
    page.push_str(page::END);
    page
}
