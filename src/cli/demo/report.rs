//! The demo's report: one HTML file that holds its style, its pictures (PNG, base64) and its charts (SVG), and needs nothing else.
//!
//! The input is plain data, so that a report can be made of anything.

use std::fmt::Write;

use crate::cli::page::{self, image};
use crate::picture::Rgb;
use crate::picture::chart::{Chart, escape, grouped, short};

/// Everything that the report shows.
#[derive(Clone, Debug, Default)]
pub struct Report {
    pub title: String,
    /// A sentence or two below the title.
    pub summary: String,
    /// What was run on: device, driver, version and the like.
    pub facts: Vec<(String, String)>,
    pub headlines: Vec<Headline>,
    /// Shown large, at the top: caption and picture.
    pub heroes: Vec<(String, Rgb)>,
    pub views: Vec<View>,
    /// One picture per column.
    pub mesh_columns: Vec<String>,
    pub mesh_rows: Vec<Vec<Rgb>>,
    pub charts: Vec<Chart>,
    pub thresholds: Vec<Threshold>,
    /// Further scores: name, value, what it means.
    pub scores: Vec<(String, String, String)>,
    /// Stage and its wall time in seconds.
    pub stages: Vec<(String, f64)>,
    pub kernels: Vec<KernelRow>,
    /// What the kernel table measures: how many steps, and which part of their time it covers.
    pub kernel_note: String,
    /// The resolved configuration as TOML.
    pub settings: String,
    /// Files and folders that were written, with what they are.
    pub files: Vec<(String, String)>,
    /// Commands that do the same by hand.
    pub commands: Vec<String>,
}

/// A number worth a big font.
#[derive(Clone, Debug, Default)]
pub struct Headline {
    pub value: String,
    pub unit: String,
    pub meaning: String,
}

/// A held-out view: what the camera saw, and what the field shows there.
#[derive(Clone, Debug)]
pub struct View {
    pub name: String,
    /// Peak signal-to-noise ratio in dB, and structural similarity.
    pub psnr: f64,
    pub ssim: f64,
    pub photo: Rgb,
    pub render: Rgb,
    pub depth: Rgb,
    pub normal: Rgb,
}

/// Scores at one distance.
#[derive(Clone, Copy, Debug)]
pub struct Threshold {
    /// World units, and as a share of the scene's radius.
    pub distance: f64,
    pub share: f64,
    pub precision: f64,
    pub recall: f64,
    pub f_score: f64,
}

/// One row of the profile. Times in milliseconds.
#[derive(Clone, Debug, Default)]
pub struct KernelRow {
    pub name: String,
    pub launches: u64,
    pub total: f64,
    /// Of the time of all kernels.
    pub share: f64,
    pub min: f64,
    pub median: f64,
    pub max: f64,
    /// Achieved arithmetic and memory traffic, where the kernel states its work.
    pub gflops: Option<f64>,
    pub gbytes: Option<f64>,
}

impl Report {
    /// The page.
    pub fn html(&self) -> String {
        let mut page = page::begin(&self.title, &self.summary);
        if !self.facts.is_empty() {
            page.push_str("<dl class=\"facts\">");
            for (name, value) in &self.facts {
                let _ = write!(
                    page,
                    "<div><dt>{}</dt><dd>{}</dd></div>",
                    escape(name),
                    escape(value)
                );
            }
            page.push_str("</dl>");
        }
        page.push_str("</header>");
        self.headlines(&mut page);
        self.views(&mut page);
        self.meshes(&mut page);
        if !self.charts.is_empty() {
            section(
                &mut page,
                "Training",
                "Faint: every logged step. Strong: running mean.",
            );
            page.push_str("<div class=\"charts\">");
            self.charts
                .iter()
                .for_each(|chart| page.push_str(&chart.figure()));
            page.push_str("</div></section>");
        }
        self.scores(&mut page);
        self.times(&mut page);
        self.settings(&mut page);
        page.push_str(page::END);
        page
    }

    fn headlines(&self, page: &mut String) {
        if !self.heroes.is_empty() {
            page.push_str("<div class=\"heroes\">");
            for (caption, picture) in &self.heroes {
                let _ = write!(
                    page,
                    "<figure>{}<figcaption>{}</figcaption></figure>",
                    image(picture, caption),
                    escape(caption)
                );
            }
            page.push_str("</div>");
        }
        page.push_str("<div class=\"headlines\">");
        for Headline {
            value,
            unit,
            meaning,
        } in &self.headlines
        {
            let _ = write!(
                page,
                "<div><p class=\"value\">{}<small>{}</small></p><p>{}</p></div>",
                escape(value),
                escape(unit),
                escape(meaning)
            );
        }
        page.push_str("</div>");
    }

    fn views(&self, page: &mut String) {
        if self.views.is_empty() {
            return;
        }
        section(
            page,
            "Held-out views",
            "Photographs that the training never saw, beside what the field shows from the same cameras.",
        );
        page.push_str(
            "<div class=\"sheet four\"><b>photograph</b><b>render</b><b>depth, near to far</b><b>normals</b>",
        );
        for view in &self.views {
            for (what, picture) in [
                ("photograph", &view.photo),
                ("render", &view.render),
                ("depth", &view.depth),
                ("normals", &view.normal),
            ] {
                page.push_str(&image(picture, &format!("{}: {what}", view.name)));
            }
            let _ = write!(
                page,
                "<p><span>{}</span><span>PSNR {:.2} dB</span><span>SSIM {:.3}</span></p>",
                escape(&view.name),
                view.psnr,
                view.ssim
            );
        }
        page.push_str("</div></section>");
    }

    fn meshes(&self, page: &mut String) {
        if self.mesh_rows.is_empty() {
            return;
        }
        section(
            page,
            "The mesh from several sides",
            "Clay in red is the inner side of an open surface.",
        );
        let _ = write!(
            page,
            "<div class=\"sheet\" style=\"--columns:{}\">",
            self.mesh_columns.len()
        );
        for column in &self.mesh_columns {
            let _ = write!(page, "<b>{}</b>", escape(column));
        }
        for picture in self.mesh_rows.iter().flatten() {
            page.push_str(&image(picture, "mesh"));
        }
        page.push_str("</div></section>");
    }

    fn scores(&self, page: &mut String) {
        if self.thresholds.is_empty() && self.scores.is_empty() {
            return;
        }
        section(
            page,
            "Scores against the exact surface",
            "Precision: the share of the mesh that lies within the distance of the true surface. Recall: the share of the true surface \
             that lies within it of the mesh. F-score: their harmonic mean.",
        );
        if !self.thresholds.is_empty() {
            page.push_str(
                "<table><thead><tr><th>within</th><th class=\"n\">of the radius</th><th class=\"n\">precision</th>\
                 <th class=\"n\">recall</th><th class=\"n\">F-score</th><th class=\"bar\"></th></tr></thead><tbody>",
            );
            for row in &self.thresholds {
                let _ = write!(
                    page,
                    "<tr><td>{:.4}</td><td class=\"n\">{} %</td><td class=\"n\">{:.3}</td><td class=\"n\">{:.3}</td>\
                     <td class=\"n\"><b>{:.3}</b></td>{}</tr>",
                    row.distance,
                    short(100.0 * row.share),
                    row.precision,
                    row.recall,
                    row.f_score,
                    bar(row.f_score)
                );
            }
            page.push_str("</tbody></table>");
        }
        if !self.scores.is_empty() {
            page.push_str("<table><tbody>");
            for (name, value, meaning) in &self.scores {
                let _ = write!(
                    page,
                    "<tr><td>{}</td><td class=\"n\"><b>{}</b></td><td class=\"note\">{}</td></tr>",
                    escape(name),
                    escape(value),
                    escape(meaning)
                );
            }
            page.push_str("</tbody></table>");
        }
        page.push_str("</section>");
    }

    fn times(&self, page: &mut String) {
        if !self.stages.is_empty() {
            section(page, "Where the time went", "");
            let total: f64 = self.stages.iter().map(|stage| stage.1).sum();
            page.push_str("<table><thead><tr><th>stage</th><th class=\"n\">time</th><th class=\"bar\"></th></tr></thead><tbody>");
            for (name, seconds) in &self.stages {
                let _ = write!(
                    page,
                    "<tr><td>{}</td><td class=\"n\">{}</td>{}</tr>",
                    escape(name),
                    duration(*seconds),
                    bar(seconds / total.max(1e-9))
                );
            }
            let _ = write!(
                page,
                "</tbody><tfoot><tr><td>total</td><td class=\"n\">{}</td><td></td></tr></tfoot></table></section>",
                duration(total)
            );
        }
        if self.kernels.is_empty() {
            return;
        }
        section(page, "Device time per kernel", &self.kernel_note);
        page.push_str(
            "<div class=\"wide\"><table class=\"dense\"><thead><tr><th>kernel</th><th class=\"n\">launches</th><th class=\"n\">total</th>\
             <th class=\"n\">share</th><th class=\"bar\"></th><th class=\"n\">min</th><th class=\"n\">median</th><th class=\"n\">max</th>\
             <th class=\"n\">GFLOP/s</th><th class=\"n\">GB/s</th></tr></thead><tbody>",
        );
        let largest = self
            .kernels
            .iter()
            .map(|row| row.share)
            .fold(1e-9, f64::max);
        let optional = |value: Option<f64>| value.map_or_else(|| "–".into(), short);
        for row in &self.kernels {
            let _ = write!(
                page,
                "<tr><td><code>{}</code></td><td class=\"n\">{}</td><td class=\"n\">{:.1} ms</td><td class=\"n\">{:.1} %</td>{}\
                 <td class=\"n\">{:.3}</td><td class=\"n\">{:.3}</td><td class=\"n\">{:.3}</td><td class=\"n\">{}</td><td class=\"n\">{}</td></tr>",
                escape(&row.name),
                grouped(row.launches as i64),
                row.total,
                100.0 * row.share,
                bar(row.share / largest),
                row.min,
                row.median,
                row.max,
                optional(row.gflops),
                optional(row.gbytes)
            );
        }
        page.push_str("</tbody></table></div></section>");
    }

    fn settings(&self, page: &mut String) {
        if !self.commands.is_empty() || !self.files.is_empty() {
            section(page, "Go on from here", "");
            if !self.files.is_empty() {
                page.push_str("<table><tbody>");
                for (file, meaning) in &self.files {
                    let _ = write!(
                        page,
                        "<tr><td><code>{}</code></td><td class=\"note\">{}</td></tr>",
                        escape(file),
                        escape(meaning)
                    );
                }
                page.push_str("</tbody></table>");
            }
            if !self.commands.is_empty() {
                let _ = write!(page, "<pre>{}</pre>", escape(&self.commands.join("\n")));
            }
            page.push_str("</section>");
        }
        if !self.settings.is_empty() {
            section(page, "Settings", "");
            let _ = write!(
                page,
                "<details><summary>Every setting of the run, as it would be given to --config</summary>\
                 <pre class=\"settings\">{}</pre></details></section>",
                escape(self.settings.trim())
            );
        }
    }
}

fn section(page: &mut String, title: &str, note: &str) {
    let _ = write!(page, "<section><h2>{}</h2>", escape(title));
    if !note.is_empty() {
        let _ = write!(page, "<p class=\"note\">{}</p>", escape(note));
    }
}

/// A table cell with a horizontal bar; `share` in [0, 1].
fn bar(share: f64) -> String {
    let share = if share.is_finite() {
        share.clamp(0.0, 1.0)
    } else {
        0.0
    };
    format!(
        "<td class=\"bar\"><i style=\"width:{:.1}%\"></i></td>",
        100.0 * share
    )
}

/// Seconds, or minutes and seconds.
pub fn duration(seconds: f64) -> String {
    if seconds < 59.95 {
        format!("{seconds:.1} s")
    } else {
        let whole = seconds.round() as u64;
        format!("{} min {:02} s", whole / 60, whole % 60)
    }
}
