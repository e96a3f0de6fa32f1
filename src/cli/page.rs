//! What the pages that are written have in common: one HTML file each, with its style and its pictures (PNG, base64) within.

use crate::picture::Rgb;
use crate::picture::chart::escape;
use base64::Engine;

/// A page up to its title and a sentence or two below it; the header is still open.
pub(super) fn begin(title: &str, lead: &str) -> String {
    const STYLE: &str = include_str!("page.css");
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>{title}</title><style>{STYLE}</style></head><body><main>\
         <header><h1>{title}</h1><p class=\"lead\">{}</p>",
        escape(lead),
        title = escape(title),
    )
}

/// What closes a page behind its last section.
pub(super) const END: &str = "</main></body></html>\n";

/// An `<img>` that holds its picture.
pub(super) fn image(picture: &Rgb, description: &str) -> String {
    format!(
        "<img width=\"{}\" height=\"{}\" alt=\"{}\" src=\"data:image/png;base64,{}\">",
        picture.width,
        picture.height,
        escape(description),
        base64::engine::general_purpose::STANDARD.encode(picture.png())
    )
}
