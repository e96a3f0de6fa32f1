//! Line charts as inline SVG, and numbers as text: what the report's figures are drawn with.

use std::fmt::Write;

/// One line of a chart.
#[derive(Clone, Debug, Default)]
pub struct Series {
    pub name: String,
    /// Abscissa and value; values that are not finite, or not positive on a logarithmic axis, are left out.
    pub points: Vec<(f64, f64)>,
}

/// A figure with one or more lines over the same abscissa.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    pub title: String,
    pub x_label: String,
    pub y_label: String,
    pub logarithmic: bool,
    pub series: Vec<Series>,
}

/// Colours that stay apart for colour-blind readers (after Okabe & Ito 2008), in the order of use.
const COLORS: [&str; 6] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9",
];
const WIDTH: f64 = 560.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 64.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 44.0;
/// A line with more points than this is drawn faintly, with its running mean on top.
const DENSE: usize = 60;

impl Chart {
    /// The chart as an `<svg>` element.
    pub fn svg(&self) -> String {
        let usable = |v: f64| v.is_finite() && (!self.logarithmic || v > 0.0);
        let scale = |v: f64| if self.logarithmic { v.log10() } else { v };
        let lines: Vec<Vec<(f64, f64)>> = self
            .series
            .iter()
            .map(|series| {
                let kept = series
                    .points
                    .iter()
                    .filter(|(x, y)| x.is_finite() && usable(*y));
                kept.map(|(x, y)| (*x, scale(*y))).collect()
            })
            .collect();
        let all: Vec<(f64, f64)> = lines.iter().flatten().copied().collect();
        let mut svg = format!(
            "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">",
            escape(&self.title)
        );
        if all.is_empty() {
            let _ = write!(
                svg,
                "<text class=\"tick\" x=\"{}\" y=\"{}\" text-anchor=\"middle\">nothing was recorded</text></svg>",
                0.5 * WIDTH,
                0.5 * HEIGHT
            );
            return svg;
        }
        let range = |pick: fn(&(f64, f64)) -> f64| {
            let low = all.iter().map(pick).fold(f64::INFINITY, f64::min);
            let high = all.iter().map(pick).fold(f64::NEG_INFINITY, f64::max);
            if high > low {
                (low, high)
            } else {
                (low - 0.5, high + 0.5)
            }
        };
        let (x_low, x_high) = range(|p| p.0);
        let (y_low, y_high) = range(|p| p.1);
        let margin = 0.05 * (y_high - y_low);
        let (y_low, y_high) = (y_low - margin, y_high + margin);
        let x_at = |x: f64| LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT);
        let y_at =
            |y: f64| HEIGHT - BOTTOM - (y - y_low) / (y_high - y_low) * (HEIGHT - TOP - BOTTOM);

        let y_ticks = if self.logarithmic {
            decades(y_low, y_high)
        } else {
            ticks(y_low, y_high, 5)
        };
        for tick in y_ticks {
            let y = y_at(tick);
            let value = if self.logarithmic {
                10f64.powf(tick)
            } else {
                tick
            };
            let _ = write!(
                svg,
                "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>\
                 <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                WIDTH - RIGHT,
                LEFT - 7.0,
                y + 4.0,
                short(value)
            );
        }
        for tick in ticks(x_low, x_high, 5) {
            let _ = write!(
                svg,
                "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                x_at(tick),
                HEIGHT - BOTTOM + 18.0,
                short(tick)
            );
        }
        let _ = write!(
            svg,
            "<line class=\"axis\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>\
             <text class=\"label\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
             <text class=\"label\" transform=\"translate(12 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            WIDTH - RIGHT,
            0.5 * (LEFT + WIDTH - RIGHT),
            HEIGHT - 6.0,
            escape(&self.x_label),
            0.5 * (TOP + HEIGHT - BOTTOM),
            escape(&self.y_label),
            y = HEIGHT - BOTTOM,
        );
        for (line, color) in lines.iter().zip(COLORS.iter().cycle()) {
            let path = |points: &[(f64, f64)]| {
                let mut path = String::new();
                for (index, (x, y)) in points.iter().enumerate() {
                    let step = if index == 0 { 'M' } else { 'L' };
                    let _ = write!(path, "{step}{:.1} {:.1}", x_at(*x), y_at(*y));
                }
                path
            };
            if line.len() > DENSE {
                let _ = write!(
                    svg,
                    "<path d=\"{}\" class=\"line faint\" stroke=\"{color}\"/><path d=\"{}\" class=\"line\" stroke=\"{color}\"/>",
                    path(line),
                    path(&running_mean(line, line.len() / 25))
                );
            } else {
                let _ = write!(
                    svg,
                    "<path d=\"{}\" class=\"line\" stroke=\"{color}\"/>",
                    path(line)
                );
                for (x, y) in line {
                    let _ = write!(
                        svg,
                        "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{color}\"/>",
                        x_at(*x),
                        y_at(*y)
                    );
                }
            }
        }
        svg.push_str("</svg>");
        svg
    }

    /// The chart in a `<figure>` with its title and, for several lines, a key.
    pub fn figure(&self) -> String {
        let mut key = String::new();
        if self.series.len() > 1 {
            for (series, color) in self.series.iter().zip(COLORS.iter().cycle()) {
                let _ = write!(
                    key,
                    "<span class=\"key\"><i style=\"background:{color}\"></i>{}</span>",
                    escape(&series.name)
                );
            }
        }
        format!(
            "<figure class=\"chart\"><figcaption><b>{}</b>{key}</figcaption>{}</figure>",
            escape(&self.title),
            self.svg()
        )
    }
}

/// Mean over `half` points to either side, as far as there are any.
fn running_mean(points: &[(f64, f64)], half: usize) -> Vec<(f64, f64)> {
    (0..points.len())
        .map(|index| {
            let window = &points[index.saturating_sub(half)..(index + half + 1).min(points.len())];
            let sum: f64 = window.iter().map(|point| point.1).sum();
            (points[index].0, sum / window.len() as f64)
        })
        .collect()
}

/// Round numbers that divide the interval into about `n` parts.
fn ticks(low: f64, high: f64, n: usize) -> Vec<f64> {
    let rough = (high - low) / n as f64;
    let magnitude = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 2.5, 5.0, 10.0]
        .into_iter()
        .map(|factor| factor * magnitude)
        .find(|step| *step >= 0.999 * rough)
        .unwrap_or(10.0 * magnitude);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|index| index as f64 * step).collect()
}

/// Logarithms of 1, 2 and 5 times the powers of ten in the interval; of the powers alone where there are many.
fn decades(low: f64, high: f64) -> Vec<f64> {
    let mantissas: &[f64] = if high - low > 2.2 {
        &[1.0]
    } else {
        &[1.0, 2.0, 5.0]
    };
    (low.floor() as i32..=high.ceil() as i32)
        .flat_map(|power| mantissas.iter().map(move |m| m.log10() + f64::from(power)))
        .filter(|tick| (low..=high).contains(tick))
        .collect()
}

/// A number with three significant digits, thousands set apart.
pub fn short(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 {
        "0".into()
    } else if size >= 999.5 {
        grouped(value.round() as i64)
    } else if size >= 1e-3 {
        let decimals = (2 - size.log10().floor() as i32).max(0) as usize;
        let text = format!("{value:.decimals$}");
        match text.split_once('.') {
            Some(_) => text.trim_end_matches('0').trim_end_matches('.').to_string(),
            None => text,
        }
    } else {
        format!("{value:.0e}")
    }
}

/// A whole number with thin spaces between groups of three digits.
pub fn grouped(value: i64) -> String {
    let digits = value.unsigned_abs().to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) && digits.len() > 4 {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    if value < 0 {
        format!("\u{2212}{text}")
    } else {
        text
    }
}

/// Text for HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short_and_whole() {
        let cases = [
            (0.0, "0"),
            (0.25, "0.25"),
            (1.0, "1"),
            (24.19, "24.2"),
            (100.0, "100"),
            (0.0999, "0.0999"),
            (1234.0, "1234"),
            (12345.6, "12\u{202f}346"),
            (1e-5, "1e-5"),
            (-0.5, "-0.5"),
        ];
        for (value, text) in cases {
            assert_eq!(short(value), text);
        }
        assert_eq!(grouped(-1_234_567), "\u{2212}1\u{202f}234\u{202f}567");
    }

    #[test]
    fn ticks_are_round_and_within() {
        assert_eq!(ticks(0.0, 2000.0, 5), [0.0, 500.0, 1000.0, 1500.0, 2000.0]);
        assert_eq!(ticks(11.3, 24.9, 5), [15.0, 20.0]);
        let few: Vec<f64> = decades(-1.4, 0.2).iter().map(|t| 10f64.powf(*t)).collect();
        assert_eq!(
            few.iter().map(|t| short(*t)).collect::<Vec<_>>(),
            ["0.05", "0.1", "0.2", "0.5", "1"]
        );
    }

    #[test]
    fn every_point_that_can_be_shown_lies_inside_the_frame() {
        let chart = Chart {
            title: "a < b".into(),
            logarithmic: true,
            series: vec![Series {
                name: "loss".into(),
                points: vec![(0.0, 3.0), (1.0, f64::NAN), (2.0, 0.0), (3.0, 1e-4)],
            }],
            ..Chart::default()
        };
        let svg = chart.svg();
        assert!(svg.contains("aria-label=\"a &lt; b\""));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 2);
        let frame = (LEFT..=WIDTH - RIGHT, TOP..=HEIGHT - BOTTOM);
        for circle in svg.split("<circle ").skip(1) {
            let number = |key: &str| {
                let text = circle.split(key).nth(1).unwrap().split('"').next().unwrap();
                text.parse::<f64>().unwrap()
            };
            assert!(
                frame.0.contains(&number("cx=\"")) && frame.1.contains(&number("cy=\"")),
                "{circle}"
            );
        }
        let nothing = Chart::default().svg();
        assert!(nothing.contains("nothing was recorded"));
    }
}
